"""Measures the localizer's speed on this computer, for ``companion self-test --bench``."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from companion.preflight.stages import StageTime, stage_times
from localizer.config import LocalizerConfig
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.engine import DualThreadEngine
from localizer.tracking.opening import MapStack, open_localizer
from localizer.types import Frame, PoseEstimate, PosePrior, ReferenceBundle

RATES_HZ = (10, 30, 60)
_WIDTHS = (320, 640)  # of the stages
_VIDEO = Camera.from_fov(1440, 1080, 60.0)
_STAGE_FRAMES = 45
_SECONDS = 4
_SPEED_M_S = 10.0
_WARM = 5  # frames that are not counted
_SWITCH_S = 2e-4  # as in flight


@dataclass(frozen=True)
class BenchRow:
    """Result at one frame rate. answered_hz: estimates a second; p50_ms, p95_ms: from a frame's
    arrival to its estimate; cpu_ms: processor time per estimate, all threads; cores: how many were
    busy; peak_mib: largest memory of the process.
    """

    offered_hz: int
    answered_hz: float
    p50_ms: float
    p95_ms: float
    cpu_ms: float
    cores: float
    peak_mib: float


def bench(
    path: Path, start: Pose, camera: Camera, config: LocalizerConfig,
    rates_hz: Sequence[int] = RATES_HZ, seconds: float = _SECONDS,
) -> Iterator[BenchRow]:  # fmt: skip
    """Yield a row for each rate, in real time: a flight at 10 m/s northwards over the map at `path`
    from `start`. Sets the interpreter's switch interval as in flight, and leaves it so.
    """
    sys.setswitchinterval(_SWITCH_S)
    for rate_hz in rates_hz:
        poses = [
            Pose(start.rotation, start.translation + np.array([0.0, _SPEED_M_S * k / rate_hz, 0.0]))
            for k in range(round(seconds * rate_hz) + _WARM)
        ]
        yield _measured(path, poses, list(_views(path, poses, camera)), config, rate_hz)


def bench_stages(path: Path, start: Pose, config: LocalizerConfig) -> list[StageTime]:
    """Time of each stage on one thread at working widths of 320 and 640, over video of 1440 x 1080
    from a lens with distortion: a flight as `bench`'s at 10 frames/s.
    """
    lens = replace(_VIDEO, distortion=(-1e-3, 0.0, 0.0, 0.0, 0.0))
    poses = [
        Pose(start.rotation, start.translation + np.array([0.0, 0.1 * _SPEED_M_S * k, 0.0]))
        for k in range(_STAGE_FRAMES)
    ]
    frames = [
        replace(view, exposure_time_ns=(k + 1) * 10**8, camera=lens)
        for k, view in enumerate(_views(path, poses, _VIDEO))
    ]
    found = []
    for width in _WIDTHS:
        single = config.model_copy(update={"width": width, "threads": 1})
        stack = MapStack(path, single)
        try:
            extractor = load_extractor(config.model, threads=1)
            prior = PosePrior.around(poses[0], 1.0, 1.0, frames[0].exposure_time_ns)
            found += stage_times(stack, frames, prior, single, extractor)
        finally:
            stack.close()
    return found


def _views(path: Path, poses: Sequence[Pose], camera: Camera) -> Iterator[Frame]:
    with TileStreamer(TileCache.open(path)) as streamer:
        renderer = NumbaRenderer(streamer, 1)
        for k, pose in enumerate(poses):
            yield Frame(renderer.render(pose, camera, wait=True).rgb, 0, camera, k)


def _measured(
    path: Path, poses: Sequence[Pose], views: Sequence[Frame], config: LocalizerConfig, rate_hz: int
) -> BenchRow:
    interval_ns = 10**9 // rate_hz
    latency_ms: list[float] = []
    memory_mib: list[float] = []

    def take(estimate: PoseEstimate, _: ReferenceBundle) -> None:
        latency_ms.append((time.monotonic_ns() - estimate.exposure_time_ns) * 1e-6)
        memory_mib.append(resident_mib())

    with open_localizer(path, views[0].camera, config) as localizer:
        began_ns = time.monotonic_ns()
        localizer.set_prior(PosePrior.around(poses[0], 1.0, 1.0, began_ns))
        localizer.track(replace(views[0], exposure_time_ns=began_ns), passes=3)
        engine = DualThreadEngine(localizer, (take,), lambda _: None)
        engine.start()
        try:
            began_ns, began_cpu, skipped = time.monotonic_ns(), time.process_time(), 0
            for k, view in enumerate(views[1:]):
                due_ns = began_ns + k * interval_ns
                time.sleep(max(due_ns - time.monotonic_ns(), 0) * 1e-9)
                if k == _WARM:
                    skipped, began_cpu = len(latency_ms), time.process_time()
                engine.submit(replace(view, exposure_time_ns=due_ns))
            seconds = (time.monotonic_ns() - began_ns) * 1e-9 - _WARM / rate_hz
            cpu_s = time.process_time() - began_cpu
        finally:
            engine.stop()
    counted = latency_ms[skipped:] or [float("nan")]
    p50_ms, p95_ms = (float(np.percentile(counted, p)) for p in (50, 95))
    return BenchRow(
        rate_hz, len(counted) / seconds, p50_ms, p95_ms, 1e3 * cpu_s / len(counted),
        cpu_s / seconds, max(memory_mib, default=float("nan")),
    )  # fmt: skip


def resident_mib() -> float:
    """Memory of this process, MiB; NaN if the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
