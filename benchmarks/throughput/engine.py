"""The dual-thread engine on a recorded sequence, in real time or as fast as it takes frames."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace

import numpy as np

from localizer.config import LocalizerConfig
from localizer.evaluation.sequences import Perturbation
from localizer.evaluation.sequences import Sequence as Recorded
from localizer.tracking.engine import DualThreadEngine
from localizer.tracking.opening import MapStack, build_localizer
from localizer.types import Frame, PoseEstimate, ReferenceBundle

_WARM = 20  # estimates that are not counted
_PATIENCE_S = 2.0  # for an estimate of a frame that was offered alone


@dataclass
class _Answers:
    """What came back, by the frame's number."""

    submitted_s: dict[int, float] = field(default_factory=dict)
    latency_ms: list[float] = field(default_factory=list)
    metres: list[float] = field(default_factory=list)
    refused: int = 0
    done: threading.Event = field(default_factory=threading.Event)


def engine_run(
    stack: MapStack, sequence: Recorded, config: LocalizerConfig, *, paced: bool
) -> dict[str, float]:
    """Frames a second, latency and processor time of the engine.

    paced: frames come when they were recorded, and one that finds the engine busy replaces the one
    that waits; else the next is offered as soon as the last is done. Frames are decoded before, and
    the sequence is gone through to its end and back, so that no frame is a jump.
    """
    frames = [sequence.frame(index) for index in range(len(sequence.images))]
    localizer = build_localizer(stack, sequence.camera, config)
    begun = Perturbation(0.5, 0.5).prior(sequence.truth[0], 0, frames[0].exposure_time_ns)
    localizer.set_prior(begun)
    localizer.track(frames[0], passes=3)
    answers = _Answers()

    def take(estimate: PoseEstimate, _: ReferenceBundle) -> None:
        answers.latency_ms.append(
            1e3 * (time.perf_counter() - answers.submitted_s[estimate.sequence])
        )
        index = estimate.sequence % len(frames)
        if estimate.accepted:
            truth = sequence.truth[index]
            answers.metres.append(truth.distance_to(estimate.world_from_camera)[0])
        else:
            answers.refused += 1
        answers.done.set()

    engine = DualThreadEngine(localizer, (take,), lambda _: None)
    engine.start()
    began, cpu, offered = time.perf_counter(), time.process_time(), 0
    counted_from = 0
    try:
        for k, frame in enumerate(frames):
            if k == _WARM:
                counted_from = len(answers.latency_ms)
                began, cpu, offered = time.perf_counter(), time.process_time(), 0
            if paced:
                due = (frame.exposure_time_ns - frames[min(k, _WARM)].exposure_time_ns) * 1e-9
                start = began if k >= _WARM else time.perf_counter()
                time.sleep(max(start + due - time.perf_counter(), 0.0))
            answers.done.clear()
            _offer(engine, answers, replace(frame, sequence=k))
            offered += 1
            if not paced or k < _WARM:
                answers.done.wait(_PATIENCE_S)
        answers.done.wait(_PATIENCE_S)
        seconds = time.perf_counter() - began
        cpu_s = time.process_time() - cpu
    finally:
        engine.stop()
    latency = np.array(answers.latency_ms[counted_from:])
    count = max(len(latency), 1)
    return {
        "frames_offered": offered,
        "frames_answered": len(latency),
        "frames_per_s": len(latency) / seconds,
        "latency_p50_ms": float(np.percentile(latency, 50)),
        "latency_p95_ms": float(np.percentile(latency, 95)),
        "cpu_ms_per_frame": 1e3 * cpu_s / count,
        "cores_used": cpu_s / seconds,
        "median_m": float(np.median(answers.metres)) if answers.metres else float("nan"),
        "p95_m": float(np.percentile(answers.metres, 95)) if answers.metres else float("nan"),
        "refused": answers.refused,
    }


def _offer(engine: DualThreadEngine, answers: _Answers, frame: Frame) -> None:
    answers.submitted_s[frame.sequence] = time.perf_counter()
    engine.submit(frame)
