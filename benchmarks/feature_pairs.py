"""Test pairs for the feature benchmark: unseen generated places, a real mesh, real photos."""

from __future__ import annotations

import json
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from localizer.camera import Camera
from localizer.geo import Geodetic
from localizer.map.build import build_cache
from localizer.map.cache import TileCache
from localizer.map.stream import TileStreamer
from localizer.pose import Pose, so3_exp
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance import CONDITIONS, apply_appearance, sample_appearance
from localizer.training.data import tamed
from localizer.training.pairs import SceneConfig, scene_pairs
from localizer.training.worlds import world_pairs
from localizer.types import Image, RenderedView

METRES, DEGREES = 5.0, 5.0  # distance of the reference view from the query's true pose
_SIZE = (320, 240)
_MADE = SceneConfig(
    width=_SIZE[0],
    height=_SIZE[1],
    references=len(CONDITIONS),
    queries_per_light=1,
    cell_m=(0.25, 0.55),
    conditions=CONDITIONS,
    motion=(METRES, DEGREES),
)


@dataclass(frozen=True)
class TestPair:
    """A rendered reference view, the query image of the same size, and the query's true pose."""

    view: RenderedView
    query: Image
    truth: Pose
    condition: str
    outdated: bool


def made_pairs(count: int, first_seed: int, threads: int) -> list[TestPair]:
    """Pairs of unseen generated places, conditions in equal shares."""

    def place(seed: int) -> list[TestPair]:
        rng = np.random.default_rng((seed, 1))
        made = []
        for pair in scene_pairs(seed, _MADE, None):
            look = tamed(sample_appearance(rng, pair.condition), pair.query_depth)
            query = apply_appearance(pair.query, pair.query_depth, look, rng)
            view = RenderedView(
                pair.reference, pair.reference_depth, pair.world_from_reference, pair.camera
            )
            made.append(TestPair(view, query, pair.world_from_query, pair.condition, pair.outdated))
        return made

    places = range(first_seed, first_seed - (-count // len(CONDITIONS)) + 2)
    with ThreadPoolExecutor(threads) as pool:
        found = [pair for pairs in pool.map(place, places) for pair in pairs]
    return found[:count]


def mesh_pairs(count: int, seed: int) -> list[TestPair]:
    """Pairs of a generated mesh world that no training run has seen."""
    rng = np.random.default_rng((seed, 2))
    made = []
    for pair in world_pairs(900_000 + seed, _MADE, count=count):
        look = tamed(sample_appearance(rng, pair.condition), pair.query_depth)
        query = apply_appearance(pair.query, pair.query_depth, look, rng)
        view = RenderedView(
            pair.reference, pair.reference_depth, pair.world_from_reference, pair.camera
        )
        made.append(TestPair(view, query, pair.world_from_query, pair.condition, False))
    return made


def real_pairs(folder: Path, count: int, seed: int) -> list[TestPair]:
    """Pairs on a real map: its own query photos where it has some, else renders with weather."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as temporary:
        photos = folder / "queries"
        origin = _origin(folder / "georef.json") if photos.exists() else None
        source = [folder / "dsm.tif", folder / "ortho.tif"] if photos.exists() else folder
        cache = Path(temporary) / "cache"
        # Heights only need to agree between map and poses here, so the separation does not matter.
        build_cache(
            source, cache, geoid_separation_m=0.0, vertical_datum="ellipsoidal", origin=origin
        )
        with TileStreamer(TileCache.open(cache)) as streamer:
            renderer = NumbaRenderer(streamer)
            if photos.exists():
                return _photo_pairs(renderer, photos, count, rng)
            return _weather_pairs(renderer, count, rng)


def _photo_pairs(
    renderer: NumbaRenderer, photos: Path, count: int, rng: np.random.Generator
) -> list[TestPair]:
    camera = Camera.from_json(photos / "camera.json").resized(*_SIZE)
    poses = json.loads((photos / "poses.json").read_text())
    names = sorted(p.name for p in (photos / "images").iterdir())
    pairs = []
    for k in range(count):
        name = names[k % len(names)]
        truth = Pose.from_matrix(poses[name]["T_enu_from_cam"])
        photo = cv2.cvtColor(cv2.imread(str(photos / "images" / name)), cv2.COLOR_BGR2RGB)
        query = cv2.resize(photo, _SIZE, interpolation=cv2.INTER_AREA)
        view = renderer.render(_disturbed(truth, rng), camera, wait=True)
        pairs.append(TestPair(view, query, truth, "photo", False))
    return pairs


def _weather_pairs(renderer: NumbaRenderer, count: int, rng: np.random.Generator) -> list[TestPair]:
    """Views of the map itself, 80 to 200 m up, under every condition in turn."""
    pairs: list[TestPair] = []
    while len(pairs) < count:
        camera = Camera.from_fov(*_SIZE, rng.uniform(40, 75))
        truth = _view(rng)
        view = renderer.render(_disturbed(truth, rng), camera, wait=True)
        seen = renderer.render(truth, camera, wait=True)
        if min((view.depth > 0).mean(), (seen.depth > 0).mean()) < 0.8:
            continue
        condition = CONDITIONS[len(pairs) % len(CONDITIONS)]
        look = tamed(sample_appearance(rng, condition), seen.depth)
        query = apply_appearance(seen.rgb, seen.depth, look, rng)
        pairs.append(TestPair(view, query, truth, condition, False))
    return pairs


def _view(rng: np.random.Generator) -> Pose:
    pitch, yaw = np.radians(rng.uniform(45, 90)), rng.uniform(0, 2 * np.pi)
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    height = rng.uniform(80, 200)
    target = np.array([rng.uniform(-220, 220), rng.uniform(-130, 130), 0.0])
    return Pose(rotation, target - forward * height / np.sin(pitch))


def _disturbed(truth: Pose, rng: np.random.Generator) -> Pose:
    shift, axis = rng.standard_normal(3), rng.standard_normal(3)
    shift *= METRES / np.linalg.norm(shift)
    axis *= np.radians(DEGREES) / np.linalg.norm(axis)
    return Pose(so3_exp(axis) @ truth.rotation, truth.translation + shift)


def _origin(georef: Path) -> Geodetic:
    origin = json.loads(georef.read_text())["origin"]
    return Geodetic(origin["lat"], origin["lon"], origin["height"])
