"""Files of a simulated flight: map cache (survey) and live cache (what the camera sees).

By default the live world has changed since the survey, and the survey has errors. The ideal world
differs from its map by light, season and cars only.

Satellite map: roofs are displaced by height times the tangent of the off-nadir angle, walls show on
one side, the imagery is blurred and equalized, and the heights contain no buildings.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import rasterio
from pyproj import CRS, Transformer
from rasterio.transform import Affine

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.importers.height_crs import utm_zone
from localizer.render.holes import fill_holes
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.config import Character, WorldConfig, look_of
from localizer.synth.visits.visit import Visit, survey_and_flight_visits
from localizer.synth.world import WorldInfo, build_visits
from localizer.types import Float32, Image
from sitl.demo.scenario import SatelliteMap

_DISTANCE_M = 60_000.0  # rays across a world are parallel to 1.5 degrees
_BLOCK_PX = 800
_GRID = 9  # nodes across a block: between them the map's and the image's coordinates are linear
_MARGIN_PX = 4
_TERRAIN_STEP_M = 5.0
_EDGE_M = 20.0  # of the world that the mosaic leaves out: its rim's walls are none
_CONTRAST, _CONTRAST_GRID = 3.0, (8, 8)
_TINT = np.array([1.05, 1.0, 1.12], np.float32)  # red, green, blue: haze


@dataclass(frozen=True)
class _Scene:
    """The imaged world and the satellite's view."""

    world: WorldInfo
    spec: SatelliteMap
    cache: TileCache
    crs: CRS

    @property
    def world_from_camera(self) -> Pose:
        """Pose of the distant camera: x lies in the map's plane, z points to the world's centre."""
        tilt, azimuth = np.radians([self.spec.off_nadir_deg, self.spec.azimuth_deg])
        eye = np.array(
            [np.sin(azimuth) * np.sin(tilt), np.cos(azimuth) * np.sin(tilt), np.cos(tilt)]
        )
        forward = -eye
        right = np.cross(
            forward, [-np.sin(azimuth), -np.cos(azimuth), 0.0] if tilt else [0, 1.0, 0]
        )
        right = right / np.linalg.norm(right)
        down = np.cross(forward, right)
        return Pose(np.stack([right, down, forward], axis=1), _DISTANCE_M * eye)

    @property
    def cache_from_world(self) -> Pose:
        """Transform from the world's ENU frame to the cache's, whose origin may differ."""
        return self.cache.frame.ecef_from_enu.inverse @ self.world.frame.ecef_from_enu

    def ground(self, x: Array, y: Array) -> Array:
        """Terrain points (..., 3), world ENU m, at x, y (m) of the map's CRS."""
        there = Transformer.from_crs(self.crs, CRS.from_epsg(4326), always_xy=True)
        longitude, latitude = there.transform(x, y)
        level = np.full(np.shape(x), self.world.origin.height_m)
        flat = self.world.frame.enu_from_geodetic(latitude, longitude, level)
        height = self.world.ground_height(flat[..., 0], flat[..., 1])
        return np.stack([flat[..., 0], flat[..., 1], height], axis=-1)

    def heights(self, x: Array, y: Array) -> Array:
        """Ellipsoidal terrain heights (...), m, at x, y (m) of the map's CRS."""
        return self.world.frame.geodetic_from_enu(self.ground(x, y))[..., 2]


def build_satellite_map(
    world: WorldInfo,
    seen: Path,
    spec: SatelliteMap,
    out: Path,
    progress: Callable[[float], None] = lambda _share: None,
) -> None:
    """Make a satellite mosaic of the world as the tile cache `seen` shows it, and import it over
    the world's bare-earth terrain as a tile cache at `out`. progress: called with the mosaic's
    share done.
    """
    cache = TileCache.open(seen)
    crs = utm_zone(world.origin.latitude_deg, world.origin.longitude_deg)
    scene = _Scene(world, spec, cache, crs)
    middle = Transformer.from_crs(CRS.from_epsg(4326), crs, always_xy=True).transform(
        world.origin.longitude_deg, world.origin.latitude_deg
    )
    side_m = world.size_m - 2 * _EDGE_M
    corner = (middle[0] - side_m / 2, middle[1] + side_m / 2)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        sources = Path(folder) / "ortho.tif", Path(folder) / "terrain.tif"
        mosaic = _processed(_mosaic(scene, corner, side_m, progress), spec)
        _write(sources[0], np.moveaxis(mosaic, 2, 0), corner, spec.texel_m, crs)
        steps = (np.arange(round(side_m / _TERRAIN_STEP_M)) + 0.5) * _TERRAIN_STEP_M
        x, y = np.meshgrid(corner[0] + steps, corner[1] - steps)
        heights = scene.heights(x, y).astype(np.float32)
        _write(sources[1], heights[None], corner, _TERRAIN_STEP_M, crs)
        options = BuildOptions(
            vertical_datum="ellipsoidal", geoid_separation_m=world.geoid_separation_m,
            origin=cache.manifest.origin, sensor="generated satellite mosaic", overwrite=True,
        )  # fmt: skip
        build_cache(sources, out, options)


def _mosaic(
    scene: _Scene, corner: tuple[float, float], side_m: float, progress: Callable[[float], None]
) -> Image:
    size = round(side_m / scene.spec.texel_m)
    mosaic = np.zeros((size, size, 3), np.uint8)
    starts = [(r, c) for r in range(0, size, _BLOCK_PX) for c in range(0, size, _BLOCK_PX)]
    with TileStreamer(scene.cache) as streamer:
        renderer = NumbaRenderer(streamer)
        try:
            for number, (row, column) in enumerate(starts, 1):
                rows, columns = (min(_BLOCK_PX, size - start) for start in (row, column))
                place = (
                    corner[0] + column * scene.spec.texel_m,
                    corner[1] - row * scene.spec.texel_m,
                )
                part = _block(scene, renderer, place, (columns, rows))
                mosaic[row : row + rows, column : column + columns] = part
                progress(number / len(starts))
        finally:
            renderer.close()
    return mosaic


def _block(
    scene: _Scene, renderer: NumbaRenderer, corner: tuple[float, float], size: tuple[int, int]
) -> Image:
    """One part of the mosaic, (rows, columns, 3): the satellite's view, resampled onto the terrain.
    corner: upper left, m of the map's CRS; size: columns, rows.
    """
    texel_m, (columns, rows) = scene.spec.texel_m, size
    x = corner[0] + np.linspace(0.0, columns * texel_m, _GRID)
    y = corner[1] - np.linspace(0.0, rows * texel_m, _GRID)
    ground = scene.ground(*np.meshgrid(x, y))
    camera_from_world = scene.world_from_camera.inverse
    points = camera_from_world.apply(ground.reshape(-1, 3)).reshape(_GRID, _GRID, 3)
    uv = _DISTANCE_M / texel_m * points[..., :2] / points[..., 2:]
    low = np.floor(uv.min(axis=(0, 1))) - _MARGIN_PX
    width, height = (int(n) for n in np.ceil(uv.max(axis=(0, 1)) - low) + _MARGIN_PX)
    camera = Camera(
        width, height, _DISTANCE_M / texel_m, _DISTANCE_M / texel_m, -float(low[0]), -float(low[1])
    )
    view = renderer.render(scene.cache_from_world @ scene.world_from_camera, camera, wait=True)
    return _resampled(fill_holes(view), uv - low, size)


def _resampled(image: Image, uv: Array, size: tuple[int, int]) -> Image:
    """Resample an image. uv: pixel coordinates (nodes, nodes, 2) on a grid over the block; size:
    columns and rows of the result.
    """
    (columns, rows), last = size, _GRID - 1
    i = ((np.arange(columns) + 0.5) / columns * last).astype(np.float32)
    j = ((np.arange(rows) + 0.5) / rows * last).astype(np.float32)
    grid = np.meshgrid(i, j)
    places: Float32 = cv2.remap(uv.astype(np.float32), *grid, cv2.INTER_LINEAR)
    drawn: Image = cv2.remap(image, places[..., 0] - 0.5, places[..., 1] - 0.5, cv2.INTER_LINEAR)
    return drawn


def _processed(mosaic: Image, spec: SatelliteMap) -> Image:
    """Blurred, its contrast equalized, and tinted, as such mosaics are published."""
    soft = cv2.GaussianBlur(mosaic, (0, 0), spec.blur_px) if spec.blur_px else mosaic
    tones = cv2.cvtColor(soft, cv2.COLOR_RGB2YCrCb)
    tones[..., 0] = cv2.createCLAHE(_CONTRAST, _CONTRAST_GRID).apply(tones[..., 0])
    tinted = cv2.cvtColor(tones, cv2.COLOR_YCrCb2RGB).astype(np.float32) * _TINT - 4.0
    processed: Image = np.clip(tinted, 0, 255).astype(np.uint8)
    return processed


def _write(
    path: Path, bands: np.ndarray, corner: tuple[float, float], step_m: float, crs: CRS
) -> None:
    profile = {
        "driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2],
        "dtype": bands.dtype, "crs": crs.to_wkt(), "tiled": True, "compress": "deflate",
        "transform": Affine(step_m, 0.0, corner[0], 0.0, -step_m, corner[1]),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as file:
        file.write(bands)


# Raised when generated worlds change, so that old ones are not flown by mistake.
_GENERATION, _IDEAL_GENERATION = 2, 1
_PAINTED = 0.8  # of the time that a world takes, its two imports being the rest


@dataclass(frozen=True)
class FlightAssets:
    """A generated world. map_cache: the companion's map; live_cache: what the camera sees."""

    world: WorldInfo
    map_cache: Path
    live_cache: Path


def _import(folder: Path, progress: Callable[[float], None], number: int) -> None:
    """Import a visit's tileset (`folder`) into the cache beside it. progress: receives the share
    done. number: 0 or 1, which of the two imports this is.
    """
    each = (1.0 - _PAINTED) / 2
    begun = _PAINTED + each * number
    build_cache(
        folder / "tileset.json",
        folder.with_name(f"{folder.name}-cache"),
        progress=lambda done, total: progress(begun + each * done / max(total, 1)),
    )


def default_folder() -> Path:
    """Folder of generated worlds: PILOT_CACHE, otherwise the user's cache folder."""
    base = os.environ.get("PILOT_CACHE")
    if base:
        return Path(base)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "pilot-companion"


def prepare(
    seed: int,
    folder: Path | None = None,
    progress: Callable[[str, float], None] = lambda _phase, _share: None,
    size_m: float = 1600.0,
    ideal: bool = False,
    character: Character = "mixed",
    satellite: SatelliteMap | None = None,
) -> FlightAssets:
    """Generate the world of a seed and import it as tile caches; existing parts are reused.

    folder: None: `default_folder`. ideal: map and live world have the same geometry and texture.
    satellite: the map is this satellite mosaic; None: the survey. progress: called with the step
    and the share done, 0 to 1; not called if nothing is missing.
    """
    generation = _IDEAL_GENERATION if ideal else _GENERATION
    name = f"world-{generation}-{seed}-{size_m:.0f}"
    home = (folder or default_folder()) / (name if character == "mixed" else f"{name}-{character}")
    done = home / "complete"
    survey, live = home / "survey", home / "live"
    if not done.exists():
        shutil.rmtree(home, ignore_errors=True)
        home.mkdir(parents=True)
        config = WorldConfig(seed, size_m, character=character)
        if ideal:
            then, now = Visit("survey", look_of("survey")), Visit("live", look_of("live"))
        else:
            then, now = survey_and_flight_visits(config)
        visits = {survey: then, live: now}
        generating = f"generating world {seed} (a few minutes, once)"
        progress(generating, 0.0)
        build_visits(config, visits, progress=lambda share: progress(generating, _PAINTED * share))
        for number, visit in enumerate(visits):
            _import(visit, partial(progress, f"importing the {visit.name} tileset"), number)
        done.touch()
    caches = (home / "survey-cache", home / "live-cache")
    world = WorldInfo.load(survey)
    if satellite is not None:
        caches = (home / f"{satellite.name}-cache", caches[1])
        if not caches[0].exists():
            painting = "painting the satellite map"
            build_satellite_map(
                world, home / "survey-cache", satellite, caches[0], partial(progress, painting)
            )
    for cache in caches:
        TileCache.open(cache)  # a damaged cache is named before the flight, not in it
    return FlightAssets(world, *caches)
