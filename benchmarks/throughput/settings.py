"""One width on so many cores: every figure of the engine, in a process of its own."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from benchmarks.throughput.engine import engine_run
from benchmarks.throughput.stages import stage_times
from companion.recorded.sequence import load_sequence
from localizer.config import LocalizerConfig
from localizer.errors import SequenceError
from localizer.evaluation.sequences import Sequence
from localizer.tracking.opening import MapStack

_STAGE_FRAMES = 60
_SWITCH_S = 2e-4  # as in the companion's process
OFFERED = {"real time": 0, "next when done": 1, "two at a time": 2}  # frames in the engine


def map_of(folder: Path) -> Path:
    """The map that a recorded sequence is of."""
    try:
        return Path((folder / "map.txt").read_text().strip())
    except OSError as error:
        raise SequenceError(f"{folder}: no map.txt: give --map, or run `record`") from error


def one_setting(
    folder: Path, width: int, cores: int, frames: int, shift_px: float | None, stages: bool
) -> list[dict[str, object]]:
    """Every figure of one width on so many cores; in a process of its own, which is bound first."""
    sys.setswitchinterval(_SWITCH_S)
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    map_cache = map_of(folder)
    found: list[dict[str, object]] = []
    config = LocalizerConfig(width=width, threads=cores, renderer="numba", device="cpu")
    if shift_px is not None:
        config = config.model_copy(update={"reference_shift_px": shift_px})
    for how, in_flight in OFFERED.items():
        stack = MapStack(map_cache, config)
        try:
            sequence = _sequence(folder, stack, frames)
            figures = engine_run(stack, sequence, config, in_flight)
        finally:
            stack.close()
        share = 100 * figures["cores_used"] / cores
        found.append(
            {
                "width": width,
                "cores": cores,
                "offered": how,
                "share_percent": share,
                "reference_shift_px": config.reference_shift_px,
                **figures,
            }
        )
    if stages:
        single = config.model_copy(update={"threads": 1})
        stack = MapStack(map_cache, single)
        try:
            spent = stage_times(stack, _sequence(folder, stack, _STAGE_FRAMES), single)
        finally:
            stack.close()
        found.append({"width": width, "cores": 1, "offered": "stages", "stage_ms": spent})
    return found


def _sequence(folder: Path, stack: MapStack, frames: int) -> Sequence:
    sequence = load_sequence(folder, stack.cache.frame).first(frames)
    if len(sequence.images) < _STAGE_FRAMES:
        raise SequenceError(f"{folder}: needs {_STAGE_FRAMES} frames: run `record` first")
    return sequence
