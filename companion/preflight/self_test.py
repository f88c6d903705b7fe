"""Localizes over a generated map: compiles the kernels, tests this computer, measures its speed.

A package runs it once at installation, so that no flight waits for the compiler. Map and image come
from the same renderer: the error shows correct computation, not accuracy.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.transform import from_origin

from companion.errors import CompanionError
from companion.integrity_monitor.video import FrozenVideoDetector
from localizer.config import LocalizerConfig
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import FeatureExtractor, load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.inspection import inspect
from localizer.registration.jngo import JNGO
from localizer.relocalization.relocalizer import open_relocalizer
from localizer.relocalization.types import PlaceQuery
from localizer.render.base import MapRenderer
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.engine import DualThreadEngine
from localizer.tracking.opening import MapStack, open_localizer
from localizer.tracking.pipeline import Localizer
from localizer.types import (
    FeaturePyramid,
    Frame,
    Image,
    PoseEstimate,
    PosePrior,
    ReferenceBundle,
    RenderedView,
)

PASSES = 3  # over the first frame
STAGES = (
    "video check", "undistort and shrink", "features of the frame", "render", "anchors and holes",
    "features of the reference", "register, judge, bound", "odometry, off the map",
    "encode a recorded image",
)  # fmt: skip
_SNAPSHOTS = 10


@dataclass(frozen=True)
class StageTime:
    """Mean time of a stage at a working width. cpu_ms: of the processor, all threads."""

    width: int
    stage: str
    cpu_ms: float
    wall_ms: float


class _Watch:
    """Milliseconds by stage: processor time on all threads (OpenVINO has its own), and time."""

    def __init__(self) -> None:
        self.spent: dict[str, list[tuple[float, float]]] = {}

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Adds what is spent inside."""
        cpu, wall = time.process_time(), time.perf_counter()
        try:
            yield
        finally:
            ms = 1e3 * (time.process_time() - cpu), 1e3 * (time.perf_counter() - wall)
            self.spent.setdefault(stage, []).append(ms)


class _Renderer(MapRenderer):
    def __init__(self, base: MapRenderer, watch: _Watch) -> None:
        super().__init__(base.streamer)
        self._base, self._watch, self.name = base, watch, base.name

    def render(self, *args: Any, **named: Any) -> RenderedView:
        with self._watch.of("render"):
            return self._base.render(*args, **named)

    def draw(self, *args: Any) -> RenderedView:
        return self._base.draw(*args)

    def close(self) -> None:
        self._base.close()


class _Extractor:
    """Counts an extraction under the half of the pipeline that asks for it."""

    def __init__(self, base: FeatureExtractor, watch: _Watch) -> None:
        self._base, self._watch, self.name = DetailExtractor(base), watch, base.name
        self.stage = "features of the reference"

    def extract(self, rgb: Image) -> FeaturePyramid:
        with self._watch.of(self.stage):
            return self._base.extract(rgb)


def stage_times(
    stack: MapStack, frames: Sequence[Frame], start: PosePrior, config: LocalizerConfig,
    extractor: FeatureExtractor,
) -> list[StageTime]:  # fmt: skip
    """The stages over an open map, from `start` at the first frame on; every frame gets a reference
    of its own. The odometry runs over the last third, without a map.
    """
    watch = _Watch()
    features = _Extractor(extractor, watch)
    localizer = Localizer(
        _Renderer(stack.renderer, watch), features,
        JNGO(config.registration, threads=config.threads), frames[0].camera, config,
        map_frame=stack.cache.frame,
    )  # fmt: skip
    localizer.set_prior(start)
    localizer.track(frames[0], passes=PASSES)
    video = FrozenVideoDetector()
    for k, frame in enumerate(frames[1:], 1):
        if k == _WARM:
            watch.spent.clear()
        with watch.of("video check"):
            video.add(frame.exposure_time_ns, frame.image)
        prior = localizer.predict(frame.exposure_time_ns)
        assert prior is not None, "the first frame began"
        anchors = None
        if k < 2 * len(frames) // 3:
            features.stage = "features of the reference"
            with watch.of("reference"):
                anchors = localizer.make_reference(prior, wait=True).anchors
        features.stage = "features of the frame"
        with watch.of("query"):
            query = localizer.extract_query(frame)
        with watch.of("odometry, off the map" if anchors is None else "register, judge, bound"):
            localizer.localize(frame, query, anchors)
    for frame in frames[:_SNAPSHOTS]:
        with watch.of("encode a recorded image"):
            cv2.imencode(".jpg", cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
    mean = {stage: np.mean(ms, axis=0) for stage, ms in watch.spent.items()}
    render, reference = mean["render"], mean["features of the reference"]
    mean["anchors and holes"] = mean.pop("reference") - render - reference
    mean["undistort and shrink"] = mean.pop("query") - mean["features of the frame"]
    return [StageTime(config.width, stage, *mean[stage].round(2).tolist()) for stage in STAGES]


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


_SIDE_M, _CELL_M = 320.0, 0.5
_GROUND_M, _ABOVE_M = 400.0, 100.0
_EAST, _NORTH = 465000.0, 5248000.0  # UTM 32N: anywhere
_OFF_M, _OFF_DEG = 5.0, 4.0
_FRAMES = 10
_GOOD_M = 0.5


class SelfTestError(CompanionError):
    """A result of the self-test is wrong on this computer."""


@dataclass(frozen=True)
class SelfTestReport:
    """Result of the self-test. error_m: of the tracked positions, worst frame; found_error_m: of
    the search without a prior; frame_ms: processor time per frame, median; compiled_s: time to the
    first result. bench, stages: of `bench` and `bench_stages`, empty if not wanted.
    """

    error_m: float
    found_error_m: float
    frame_ms: float
    compiled_s: float
    features: str
    bench: tuple[BenchRow, ...] = ()
    stages: tuple[StageTime, ...] = ()


def self_test(
    folder: Path,
    say: Callable[[str], None],
    config: LocalizerConfig | None = None,
    *,
    timed: bool = False,
) -> SelfTestReport:
    """Build a map in `folder` (as `generate_map`), track frames over it and find one without a
    prior. timed: measure the speed, too.
    Raises SelfTestError if a result is off by more than 0.5 m, or if none is accepted.
    """
    config = config or LocalizerConfig()
    say("building a map")
    cache = generate_map(folder)
    pose, frame = render_view(cache, config)
    say("compiling and tracking")
    tracked = _track(folder / "map", pose, frame, config)
    say("searching without a prior")
    found_m = _search(cache, pose, frame, config)
    report = SelfTestReport(tracked[0], found_m, *tracked[1:])
    worst = max(report.error_m, report.found_error_m)
    if not worst <= _GOOD_M:
        raise SelfTestError(
            f"the self-test is {worst:.2f} m off where {_GOOD_M} m is the most: this computer or "
            "its packages compute wrongly; do not fly with them"
        )
    if not timed:
        return report
    say("measuring the speed, which is only right while nothing else runs")
    rows = tuple(bench(folder / "map", pose, frame.camera, config))
    return replace(report, bench=rows, stages=tuple(bench_stages(folder / "map", pose, config)))


def generate_map(folder: Path) -> TileCache:
    """Build a map without repetition, from a DSM and an orthophoto as a user brings them. Writes
    ``dsm.tif``, ``ortho.tif`` and ``map/`` into an existing folder.
    """
    n = round(_SIDE_M / _CELL_M)
    rng = np.random.default_rng(0)
    colours = [_blotches(rng, n, px) for px in (3, 8, 20, 60)]
    rgb = np.clip(110.0 + sum(colours), 0, 255).astype(np.uint8)
    heights = _GROUND_M + 3.0 * _blotches(rng, n, 40)[..., :1] / 40.0
    dsm, ortho = folder / "dsm.tif", folder / "ortho.tif"
    _write(dsm, heights.astype(np.float32), nodata=-9999.0)
    _write(ortho, rgb)
    options = BuildOptions(vertical_datum="ellipsoidal", geoid_separation_m=48.0, workers=1)
    build_cache([dsm, ortho], folder / "map", options)
    return TileCache.open(folder / "map")


def _blotches(rng: np.random.Generator, n: int, size_px: int) -> np.ndarray:
    """Random blotches (n, n, 3) of about size_px pixels, gray levels about 0."""
    coarse = rng.normal(0.0, 40.0, (n // size_px + 2, n // size_px + 2, 3))
    return np.asarray(cv2.resize(coarse, (n, n), interpolation=cv2.INTER_CUBIC))


def _write(path: Path, raster: np.ndarray, **profile: float) -> None:
    rows, columns, bands = raster.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=bands, dtype=raster.dtype,
        crs="EPSG:32632", transform=from_origin(_EAST, _NORTH, _CELL_M, _CELL_M), **profile,
    ) as file:  # fmt: skip
        file.write(np.moveaxis(raster, -1, 0))


def render_view(cache: TileCache, config: LocalizerConfig) -> tuple[Pose, Frame]:
    """Render a view from 100 m above the ground at the map's middle: its pose world_from_camera,
    and a frame of the configured width as the camera would give it. Its exposure time is 1 s.
    """
    camera = Camera.from_fov(config.width, config.width * 3 // 4, 60.0)
    middle = cache.frame.position((0.0, 0.0, 0.0))  # a source's centre is its origin
    pose = inspect.camera_pose(
        cache, middle.latitude_deg, middle.longitude_deg, _GROUND_M + _ABOVE_M, 20.0, -75.0
    )
    seen = inspect.render_view(cache, pose, camera)
    return pose, Frame(seen.rgb, 1_000_000_000, camera, 0)


def _track(
    path: Path, pose: Pose, frame: Frame, config: LocalizerConfig
) -> tuple[float, float, float, str]:
    """Worst error (m), processor time per frame (ms), time to the first result (s), and what
    computes the features.
    """
    began = time.perf_counter()
    off = Pose(pose.rotation, pose.translation + np.array([_OFF_M, -_OFF_M, 0.0]))
    spent_ms, errors, compiled_s = [], [], 0.0
    with open_localizer(path, frame.camera, config) as localizer:
        localizer.set_prior(PosePrior.around(off, _OFF_M, _OFF_DEG, frame.exposure_time_ns))
        for k in range(_FRAMES):
            time_ns = frame.exposure_time_ns + k * 100_000_000
            used = time.process_time()
            found = localizer.track(
                Frame(frame.image, time_ns, frame.camera, k), passes=3 if k == 0 else 1
            )
            spent_ms.append((time.process_time() - used) * 1e3)
            compiled_s = compiled_s or time.perf_counter() - began
            if not found.accepted:
                raise SelfTestError(f"frame {k} is refused ({found.status.value}): do not fly")
            apart = found.world_from_camera.translation - pose.translation
            errors.append(float(np.linalg.norm(apart)))
        features = localizer.features_name
    return max(errors), float(np.median(spent_ms[1:])), compiled_s, features


def _search(cache: TileCache, pose: Pose, frame: Frame, config: LocalizerConfig) -> float:
    opened = open_relocalizer(cache, config)
    assert opened is not None  # nothing stops it
    tilt, heading = math.radians(1.0), math.radians(15.0)
    height_m = float(pose.translation[2])
    query = PlaceQuery(frame, pose.rotation, tilt, heading, height_m, 2.0)
    with opened as relocalizer:
        found = relocalizer.find(query)
    if found is None:
        raise SelfTestError("the search finds no position where it should: do not fly")
    return float(np.linalg.norm(found.world_from_camera.translation - pose.translation))
