"""Views for the convergence benchmark, kept in a folder: query images with their true poses.

A set is one or more maps (tile caches) and the views of them. Generated worlds have seeds that no
training uses; the query shows the place on another day (sun, season, traffic) under its own weather
and sensor. Real maps: photos where there are some, else renders of the map under made weather. The
reference views are rendered from the map when they are needed, at whatever pose is asked for.
"""

from __future__ import annotations

import json
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common.maps import build_map, layers_of, origin_of
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.pictures import read_rgb
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import CONDITIONS, apply_appearance, sample_appearance
from localizer.synth.config import SURVEY, WorldConfig
from localizer.synth.visits.visit import Visit, draw_look
from localizer.synth.world import build_visits
from localizer.training.data.batches import limit_haze
from localizer.training.data.pairs import look_at, soften
from localizer.types import Image, RenderedView

SIZE = (320, 240)
WORLD_SEED = 2_000_000  # training and the feature benchmark stay below
VIEWS_PER_WORLD = 40
WORLD_M = 800.0
_LEAST_MAP = 0.9  # share of the true view that shows the map


@dataclass(frozen=True)
class BasinView:
    """One query. map_cache: the tile cache of its place; height: of the camera above ground, m."""

    map_cache: Path
    query: Image
    truth: Pose
    camera: Camera
    condition: str
    height: float


def load_views(name: str, folder: Path, data: Path, count: int) -> list[BasinView]:
    """At least `count` views of a set, where it has so many, made on the first call.

    name: "generated", or a folder of `data` ("quito", "portugal", "caliterra").
    """
    home = folder / name
    if name == "generated":
        places = [home / f"{WORLD_SEED + k}" for k in range(-(-count // VIEWS_PER_WORLD))]
        with ProcessPoolExecutor(2) as pool:
            list(pool.map(_make_world, [p for p in places if not (p / "views.npz").exists()]))
        return [v for p in places for v in load_kept(p)][:count]
    if not (home / "views.npz").exists():
        _make_real(data / name, home, count)
    return load_kept(home)[:count]


def _make_world(home: Path) -> None:
    seed = int(home.name)
    rng = np.random.default_rng(seed)
    visits = {home / "survey": Visit("survey", SURVEY), home / "day": Visit("live", draw_look(rng))}
    info = build_visits(WorldConfig(seed, WORLD_M), visits, processes=1)[0]
    for folder in visits:
        build_cache(
            folder,
            home / f"{folder.name}.cache",
            BuildOptions(origin=info.origin, workers=1, overwrite=True),
        )
    half = 0.36 * WORLD_M
    store_renders(home, home / "survey.cache", home / "day.cache", (half, half), rng,
                   VIEWS_PER_WORLD)  # fmt: skip


def _make_real(source: Path, home: Path, count: int) -> None:
    home.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    cache = build_map(layers_of(source), home / "map.cache", origin_of(source))
    if (source / "queries").exists():
        _store(home, photo_views(cache, source / "queries"))
    else:
        halves = {"quito": (220.0, 130.0), "portugal": (100.0, 110.0)}
        store_renders(home, cache, cache, halves[source.name], rng, count)


def photo_views(cache: Path, photos: Path, size: tuple[int, int] = SIZE) -> list[BasinView]:
    """The photos of a folder with camera.json and poses.json, of `size` (width, height)."""
    camera = Camera.from_json(photos / "camera.json").resized(*size)
    poses = json.loads((photos / "poses.json").read_text())
    views = []
    for path in sorted((photos / "images").iterdir()):
        photo = read_rgb(path)
        query = cv2.resize(photo, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        truth = Pose.from_matrix(np.array(poses[path.name]["T_enu_from_cam"]))
        views.append(BasinView(cache, query, truth, camera, "photo", 40.0))
    return views


def store_renders(
    home: Path,
    map_cache: Path,
    day_cache: Path,
    half: tuple[float, float],
    rng: np.random.Generator,
    count: int,
) -> None:
    """Views from 55 to 220 m above ground, straight down to 30 degrees below the horizon."""
    views: list[BasinView] = []
    with (
        TileStreamer(TileCache.open(map_cache)) as survey,
        TileStreamer(TileCache.open(day_cache)) as day,
    ):
        map_renderer, day_renderer = NumbaRenderer(survey, 1), NumbaRenderer(day, 1)
        while len(views) < count:
            truth, camera, height = _random_pose(map_renderer, half, rng)
            view = map_renderer.render(truth, camera, wait=True)
            seen = day_renderer.render(truth, camera, wait=True)
            if min((view.depth > 0).mean(), (seen.depth > 0).mean()) < _LEAST_MAP:
                continue
            condition = CONDITIONS[len(views) % len(CONDITIONS)]
            query = _weathered(seen, condition, rng)
            views.append(BasinView(map_cache, query, truth, camera, condition, height))
    _store(home, views)


def _random_pose(
    renderer: NumbaRenderer, half: tuple[float, float], rng: np.random.Generator
) -> tuple[Pose, Camera, float]:
    """A pose world_from_camera, its camera and its height above the ground that it looks at, m."""
    camera = Camera.from_fov(*SIZE, float(rng.uniform(40, 85)))
    target = np.array([*rng.uniform(-1, 1, 2) * half, 0.0])
    target[2] = ground_height(renderer, target)
    pitch = np.radians(90 - 60 * rng.random() ** 1.4)
    height = float(np.exp(rng.uniform(np.log(55), np.log(220))))
    return look_at(target, height / np.sin(pitch), pitch, rng), camera, height


def _weathered(seen: RenderedView, condition: str, rng: np.random.Generator) -> Image:
    look = limit_haze(sample_appearance(rng, condition), seen.depth)
    return apply_appearance(soften(rng, seen.rgb), seen.depth, look, rng)


def ground_height(renderer: NumbaRenderer, target: np.ndarray) -> float:
    """Height of the map at `target`'s east and north, from a small view straight down."""
    top = Pose(np.diag([1.0, -1.0, -1.0]), np.array([*target[:2], 1500.0]))
    depth = renderer.render(top, Camera.from_fov(16, 16, 2.0), wait=True).depth[8, 8]
    return 1500.0 - float(depth) if depth > 0 else 0.0


def _store(home: Path, views: list[BasinView]) -> None:
    np.savez(
        home / "views.npz",
        map_cache=np.array([os.path.relpath(v.map_cache, home) for v in views]),
        query=np.stack([v.query for v in views]),
        truth=np.stack([v.truth.matrix for v in views]),
        camera=np.array([json.dumps(v.camera.to_dict()) for v in views]),
        condition=np.array([v.condition for v in views]),
        height=np.array([v.height for v in views]),
    )


def load_kept(home: Path) -> list[BasinView]:
    """The views that a folder keeps."""
    with np.load(home / "views.npz") as f:
        return [
            BasinView((home / str(m)).resolve(), q, Pose.from_matrix(t),
                 Camera.from_dict(json.loads(str(c))), str(k), float(h))
            for m, q, t, c, k, h in zip(
                f["map_cache"], f["query"], f["truth"], f["camera"], f["condition"], f["height"],
                strict=True,
            )
        ]  # fmt: skip
