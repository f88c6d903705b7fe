"""Real sets: a map, photos or renders over it, their true poses and how well those are known.

A small file describes each set (`benchmarks/real/sets/NAME.json`): what it is, where its map and
its photos are in the data folder, the uncertainty of its truth, and the camera's calibration.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from benchmarks.basin.views import BasinView, load_views
from benchmarks.common.maps import build_map, origin_of, write_raster
from benchmarks.features.real import plot_dates, unseen_plots
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.geometry.trajectory import read_poses, world_from_camera
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.pictures import read_rgb
from localizer.registration.calibration import CalibrationSigmas
from localizer.render.numba_raster import NumbaRenderer
from localizer.tracking.pipeline import Undistorter, working_camera
from localizer.training.data.pairs import look_at
from localizer.types import Frame, Image

DESCRIPTIONS = Path(__file__).with_name("sets")
SETS = tuple(sorted(path.stem for path in DESCRIPTIONS.glob("*.json")))
_PLOT_GSD_M = 0.1
_VIEWS_A_PLOT = 2
_LEAST_MAP = 0.9  # share of a render that shows the map


class SetDescription(BaseModel):
    """One set. source: "photos" with poses.txt and camera.json in `photos`; "renders" of the map
    under made weather; "seasons": plots that were photographed at two dates, one of them the map.

    map_files: in the data folder. position_sigma_m: of the truth, per axis; right_m: largest error
    on the ground, in the middle of the image, of a registration that is right; calibration: of the
    camera and of the map's survey.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    what: str
    source: Literal["photos", "renders", "seasons"]
    map_files: tuple[str, ...]
    photos: str = ""
    count: int = Field(40, ge=1)
    position_sigma_m: float = Field(ge=0)
    rotation_sigma_deg: float = Field(ge=0)
    right_m: float = Field(gt=0)
    calibration: CalibrationSigmas


@dataclass(frozen=True)
class RealView:
    """One image. file: of the photo; rgb: the image itself where there is no file."""

    map_cache: Path
    camera: Camera
    truth: Pose
    condition: str
    file: Path | None = None
    rgb: Image | None = None

    def image(self) -> Image:
        """(H, W, 3) uint8, with the camera's distortion."""
        if self.rgb is not None:
            return self.rgb
        if self.file is None:
            raise ValueError("a view has a file or an image")
        return read_rgb(self.file)

    def at_width(self, width: int) -> BasinView:
        """The view without distortion, so many px wide."""
        camera = working_camera(self.camera, width)
        rgb = Undistorter(self.camera, camera)(Frame(self.image(), 0, self.camera, 0))
        return BasinView(self.map_cache, rgb, self.truth, camera, self.condition, 0.0)


def describe(name: str) -> SetDescription:
    """The description of a set; KeyError where there is none of that name."""
    path = DESCRIPTIONS / f"{name}.json"
    if name not in SETS:
        raise KeyError(f"{name}: no such set, there are: {', '.join(SETS)}")
    return SetDescription.model_validate(json.loads(path.read_text(encoding="utf-8")))


def load(name: str, work: Path, data: Path) -> list[RealView]:
    """The views of a set; maps are built in `work` on the first call. data: the real data."""
    described = describe(name)
    if described.source == "photos":
        return _photos(described, work / name, data)
    if described.source == "seasons":
        return _seasons(described, work / name, data)
    views = load_views(name, work, data, described.count)
    return [RealView(v.map_cache, v.camera, v.truth, v.condition, rgb=v.query) for v in views]


def _photos(described: SetDescription, home: Path, data: Path) -> list[RealView]:
    cache = home / "photo-map.cache"
    if not cache.exists():
        files = [data / file for file in described.map_files]
        build_map(files, cache, origin_of(files[0].parent))
    photos = data / described.photos
    camera = Camera.from_json(photos / "camera.json")
    frame = TileCache.open(cache).frame
    return [
        RealView(
            cache, camera, world_from_camera(row, frame), "photo", photos / "images" / row.name
        )
        for row in read_poses(photos / "poses.txt")
    ]


def _seasons(described: SetDescription, home: Path, data: Path) -> list[RealView]:
    """Each unseen plot: one date as the map and views of the other, and the other way round."""
    views: list[RealView] = []
    for index, plot in enumerate(unseen_plots(data / described.map_files[0])):
        caches = [_plot_map(home / f"{plot.name}-{k}", p) for k, p in enumerate(plot_dates(plot))]
        for surveyed, flown in ((0, 1), (1, 0)):
            with TileStreamer(TileCache.open(caches[flown])) as streamer:
                renderer = NumbaRenderer(streamer, 1)
                draw = partial(_plot_view, renderer, caches[surveyed])
                for k in range(_VIEWS_A_PLOT):
                    view = draw(np.random.default_rng((3, index, surveyed, k)))
                    views += [view] if view is not None else []
    return views


def _plot_view(
    renderer: NumbaRenderer, surveyed: Path, rng: np.random.Generator
) -> RealView | None:
    camera = Camera.from_fov(320, 240, float(rng.uniform(35, 50)))
    pitch, at = np.radians(rng.uniform(72, 90)), rng.uniform(-6, 6, 2)
    distance = rng.uniform(25, 35) / np.sin(pitch)
    truth = look_at(np.array([*at, 0.0]), float(distance), float(pitch), rng)
    view = renderer.render(truth, camera, wait=True)
    if (view.depth > 0).mean() < _LEAST_MAP:
        return None
    return RealView(surveyed, camera, truth, "other season", rgb=view.rgb)


def _plot_map(home: Path, picture: Path) -> Path:
    """A flat map of one orthophoto."""
    cache = home / "map.cache"
    if cache.exists():
        return cache
    home.mkdir(parents=True, exist_ok=True)
    rgb = read_rgb(picture)
    side = int(rgb.shape[0] * _PLOT_GSD_M)
    flat = np.zeros((1, side, side), np.float32)
    layers = (("ortho", rgb.transpose(2, 0, 1), _PLOT_GSD_M), ("dsm", flat, 1.0))
    for name, array, step in layers:
        write_raster(home / f"{name}.tif", array, step, "EPSG:32611", (260_000.0, 4_110_000.0))
    build_map([home / "dsm.tif", home / "ortho.tif"], cache)
    return cache
