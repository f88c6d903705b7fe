"""Localizes over a generated map: compiles the kernels and tests this computer.

A package runs it once at installation, so that no flight waits for the compiler. Map and image come
from the same renderer: the error shows correct computation, not accuracy.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.transform import from_origin

from companion.errors import CompanionError
from companion.preflight.bench import BenchRow, bench, bench_stages
from companion.preflight.stages import StageTime
from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.inspection import inspect
from localizer.relocalization.relocalizer import open_relocalizer
from localizer.relocalization.types import PlaceQuery
from localizer.tracking.opening import open_localizer
from localizer.types import Frame, PosePrior

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
        raise SelfTestError("the search finds no place where it should: do not fly")
    return float(np.linalg.norm(found.world_from_camera.translation - pose.translation))
