"""One width on so many cores: every figure of the engine, in a process of its own."""

from __future__ import annotations

import os
import sys
from dataclasses import asdict, replace
from pathlib import Path

from benchmarks.throughput.engine import engine_run
from companion.preflight.self_test import StageTime, stage_times
from companion.recorded.sequence import load_sequence
from localizer.config import LocalizerConfig
from localizer.errors import SequenceError
from localizer.evaluation.sequences import Perturbation, Sequence
from localizer.features.extractor import load_extractor
from localizer.tracking.opening import MapStack

_STAGE_FRAMES = 60
_AT_HZ = 30  # spacing of the frames where none waits for its time
_SWITCH_S = 2e-4  # as in the companion's process
# Frames a second, and frames in the engine; 0: in real time.
OFFERED = {
    "10 a second": (10, 0), "30 a second": (30, 0), "60 a second": (60, 0),
    "next when done": (_AT_HZ, 1), "two at a time": (_AT_HZ, 2),
}  # fmt: skip


def map_of(folder: Path) -> Path:
    """The map that a recorded sequence is of."""
    try:
        return Path((folder / "map.txt").read_text().strip())
    except OSError as error:
        raise SequenceError(f"{folder}: no map.txt: give --map, or run `record`") from error


def one_setting(
    folder: Path, width: int, cores: int, frames: int, shift_px: float | None, how: str
) -> list[dict[str, object]]:
    """The figures of one width on so many cores, as `OFFERED` or, if `how` is not of it, of each
    stage; in a process of its own, which is bound first. Empty if the recording is too slow.
    """
    sys.setswitchinterval(_SWITCH_S)
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    config = LocalizerConfig(width=width, threads=cores, renderer="numba", device="cpu")
    if shift_px is not None:
        config = config.model_copy(update={"reference_shift_px": shift_px})
    if how not in OFFERED:
        config = config.model_copy(update={"threads": 1})
    rate_hz, in_flight = OFFERED.get(how, (_AT_HZ, 0))
    stack = MapStack(map_of(folder), config)
    try:
        sequence = _sequence(folder, stack, frames, rate_hz)
        if sequence is None:
            return []
        if how not in OFFERED:
            return [{"offered": how, **asdict(stage)} for stage in _stages(sequence, stack, config)]
        figures = engine_run(stack, sequence, config, in_flight)
    finally:
        stack.close()
    share = 100 * figures["cores_used"] / cores
    return [
        {
            "width": width,
            "cores": cores,
            "offered": how,
            "share_percent": share,
            "reference_shift_px": config.reference_shift_px,
            **figures,
        }
    ]


def _stages(sequence: Sequence, stack: MapStack, config: LocalizerConfig) -> list[StageTime]:
    views = [sequence.frame(k) for k in range(_STAGE_FRAMES)]
    start = Perturbation(1.0, 1.0).prior(sequence.truth[0], 0, views[0].exposure_time_ns)
    return stage_times(stack, views, start, config, load_extractor(config.model, threads=1))


def _sequence(folder: Path, stack: MapStack, frames: int, rate_hz: int) -> Sequence | None:
    """The recorded frames at a rate: every so many of them; None if it has fewer."""
    whole = load_sequence(folder, stack.cache.frame).first(frames)
    t = whole.times_ns
    step = int(0.1 + (len(t) - 1) * 1e9 / max(t[-1] - t[0], 1) / rate_hz)
    if not step:
        return None
    if len(t) < step * _STAGE_FRAMES:
        raise SequenceError(
            f"{folder}: {len(t)} frames, of which {_STAGE_FRAMES} at {rate_hz}/s are needed: run "
            "`record` first"
        )
    return replace(
        whole, images=whole.images[::step], times_ns=t[::step], truth=whole.truth[::step]
    )
