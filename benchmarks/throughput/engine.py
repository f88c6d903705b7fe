"""The dual-thread engine on a recorded sequence, in real time or as fast as it takes frames."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace

import numpy as np

from companion.preflight.self_test import resident_mib
from localizer.config import LocalizerConfig
from localizer.evaluation.sequences import Perturbation
from localizer.evaluation.sequences import Sequence as Recorded
from localizer.tracking.engine import DualThreadEngine
from localizer.tracking.opening import MapStack, build_localizer
from localizer.types import Frame, PoseEstimate, ReferenceBundle

_WARM = 20  # estimates that are not counted
_LOOK_S = 5e-4
_PATIENCE_S = 2.0  # for an estimate of one frame


@dataclass
class _Answers:
    """What came back, by the frame's number."""

    submitted_s: dict[int, float] = field(default_factory=dict)
    latency_ms: list[float] = field(default_factory=list)
    metres: list[float] = field(default_factory=list)
    refused: int = 0
    last: int = -1
    changed: threading.Condition = field(default_factory=threading.Condition)

    def wait_for(self, sequence: int) -> None:
        """Until this frame or a later one has been answered; not for ever."""
        with self.changed:
            self.changed.wait_for(lambda: self.last >= sequence, _PATIENCE_S)


def engine_run(
    stack: MapStack, sequence: Recorded, config: LocalizerConfig, in_flight: int
) -> dict[str, float]:
    """Frames a second, latency, processor time and memory (without the frames) of the engine.

    in_flight: how many frames the engine has at a time; 0: they come when they were recorded, and
    one that finds the engine busy replaces the one that waits. Frames are decoded before.
    """
    frames = [sequence.frame(index) for index in range(len(sequence.images))]
    localizer = build_localizer(stack, sequence.camera, config)
    begun = Perturbation(0.5, 0.5).prior(sequence.truth[0], 0, frames[0].exposure_time_ns)
    localizer.set_prior(begun)
    localizer.track(frames[0], passes=3)
    answers = _Answers()

    decoded_mib = sum(frame.image.nbytes for frame in frames) / 2**20
    memory_mib: list[float] = []

    def take(estimate: PoseEstimate, _: ReferenceBundle) -> None:
        memory_mib.append(resident_mib() - decoded_mib)
        answers.latency_ms.append(
            1e3 * (time.perf_counter() - answers.submitted_s[estimate.sequence])
        )
        index = estimate.sequence % len(frames)
        if estimate.accepted:
            truth = sequence.truth[index]
            answers.metres.append(truth.distance_to(estimate.world_from_camera)[0])
        else:
            answers.refused += 1
        with answers.changed:
            answers.last = estimate.sequence
            answers.changed.notify()

    engine = DualThreadEngine(localizer, (take,), lambda _: None)
    engine.start()
    began, cpu, offered = time.perf_counter(), time.process_time(), 0
    counted_from, first_ns, references = 0, 0, 0
    try:
        for k, frame in enumerate(frames):
            if in_flight or k <= _WARM:
                answers.wait_for(k - (1 if k <= _WARM else in_flight))
                while engine.is_full:  # the next would displace it
                    time.sleep(_LOOK_S)
            if k == _WARM:
                counted_from = len(answers.latency_ms)
                began, cpu, offered = time.perf_counter(), time.process_time(), 0
                first_ns, references = frame.exposure_time_ns, engine.health.references
            if not in_flight and k > _WARM:
                due = began + (frame.exposure_time_ns - first_ns) * 1e-9
                time.sleep(max(due - time.perf_counter(), 0.0))
            _offer(engine, answers, replace(frame, sequence=k))
            offered += 1
        answers.wait_for(len(frames) - 1)
        seconds = time.perf_counter() - began
        cpu_s = time.process_time() - cpu
    finally:
        engine.stop()
    latency = np.array(answers.latency_ms[counted_from:])
    count = max(len(latency), 1)
    return {
        "frames_offered": offered,
        "frames_answered": len(latency),
        "references": engine.health.references - references,
        "frames_per_s": len(latency) / seconds,
        "latency_p50_ms": float(np.percentile(latency, 50)),
        "latency_p95_ms": float(np.percentile(latency, 95)),
        "cpu_ms_per_frame": 1e3 * cpu_s / count,
        "cores_used": cpu_s / seconds,
        "peak_mib": max(memory_mib, default=float("nan")),
        "median_m": float(np.median(answers.metres)) if answers.metres else float("nan"),
        "p95_m": float(np.percentile(answers.metres, 95)) if answers.metres else float("nan"),
        "refused": answers.refused,
    }


def _offer(engine: DualThreadEngine, answers: _Answers, frame: Frame) -> None:
    answers.submitted_s[frame.sequence] = time.perf_counter()
    engine.submit(frame)
