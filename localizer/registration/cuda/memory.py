"""Device memory layout of one frame's registration: one block."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localizer.registration.cuda import layout

PROBES = 13  # poses at which the curvature is measured: `curvature_steps`


@dataclass(frozen=True)
class FrameMemory:
    """Addresses in the frame's block: levels, motion, first swarm | prior, state, last swarm |
    scratch. The first part and the state are uploaded, the last swarm is downloaded.
    """

    base: int
    levels: int
    motion: int
    prior: int
    state: int
    swarms: tuple[NDArray[np.void], ...]
    trial: tuple[int, int]
    totals: int
    order: int
    alive: int
    projected: int
    finish: int
    probes: NDArray[np.void]
    probe_state: int
    upload_size: int
    result_size: int

    @classmethod
    def of(
        cls,
        buffer: Callable[[str, int], int],
        levels: int,
        count: int,
        survivors: int,
        anchors: int,
    ) -> FrameMemory:
        """The layout for numbers of levels, hypotheses (the start poses twice), survivors and
        anchors. buffer: returns device memory by name and size.
        """
        sizes = [
            ("level", layout.LEVEL.itemsize * levels),
            ("motion", layout.MOTION.itemsize),
            ("R0", 72 * count), ("t0", 24 * count),
            ("prior", layout.PRIOR.itemsize), ("state", layout.STATE.itemsize),
            ("R2", 72 * survivors), ("t2", 24 * survivors),
            ("s2", 8 * survivors), ("v2", 4 * survivors),
            ("s0", 8 * count), ("v0", 4 * count),
            ("R1", 72 * count), ("t1", 24 * count), ("s1", 8 * count), ("v1", 4 * count),
            ("trial score", 8), ("trial visible", 4),
            ("totals", 8 * count), ("order", 4 * count), ("alive", 4 * count),
            ("projected", 4 * layout.PROBE_FLOATS * count),
            ("finish", 4 * layout.WINNER_FLOATS * anchors),
            ("R3", 72 * PROBES), ("t3", 24 * PROBES), ("s3", 8 * PROBES), ("v3", 4 * PROBES),
            ("probe state", layout.STATE.itemsize),
        ]  # fmt: skip
        offsets, end = {}, 0
        for name, size in sizes:
            offsets[name] = end
            end += -(-size // 16) * 16
        base = buffer("frame", end)
        at = {name: base + offset for name, offset in offsets.items()}
        swarms = []
        for k in range(4):
            swarm = np.zeros((), dtype=layout.SWARM)
            for field, key in zip(
                ("rotations", "translations", "scores", "visible"), "Rtsv", strict=True
            ):
                swarm[field] = at[f"{key}{k}"]
            swarms.append(swarm)
        return cls(
            base, at["level"], at["motion"], at["prior"], at["state"], tuple(swarms[:3]),
            (at["trial score"], at["trial visible"]), at["totals"], at["order"], at["alive"],
            at["projected"], at["finish"], swarms[3], at["probe state"], offsets["R2"],
            offsets["s0"] - offsets["prior"],
        )  # fmt: skip

    def level(self, k: int) -> int:
        """Device address of the description of pyramid level k."""
        return self.levels + k * layout.LEVEL.itemsize

    def write(self, frame: NDArray[np.uint8], address: int, value: NDArray[Any]) -> None:
        """Write a value to the host's copy of the block."""
        start = address - self.base
        frame[start : start + value.nbytes] = value.reshape(-1).view(np.uint8)

    def winner(self, swarm: NDArray[np.void]) -> NDArray[np.void]:
        """The swarm with separate score addresses: sharpening must not change the ranking."""
        out: NDArray[np.void] = swarm.copy()
        out["scores"], out["visible"] = self.trial
        return out
