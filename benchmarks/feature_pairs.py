"""Test pairs for the feature benchmark: unseen generated places, a mesh world, real sets.

What differs between map and query is drawn by the training's own generator, with other seeds and
with real textures that no training run has seen; docs/model-card.md says what each difference
stands for. `shared_detail` is the easier condition of earlier reports.
"""

from __future__ import annotations

import json
import tempfile
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
from localizer.training.pairs import COMBINED, OUTDATED, SEASON, Pair, SceneConfig
from localizer.training.revisit import coarser, draw_texel, hard_surfaces, regrown
from localizer.training.shards import PhotoSource, read_shard, shard_path, write_shards
from localizer.training.worlds import world_pairs
from localizer.types import Float32, Image, RenderedView

METRES, DEGREES = 5.0, 5.0  # distance of the reference view from the query's true pose
UNSEEN_GROUPS = ("boruszyn", "garfield_autumn", "neon_sjer_pairs")
MADE_CONDITIONS = (*CONDITIONS, SEASON, OUTDATED, COMBINED)
_FIRST_SEED = {"test": 5_000_000, "validation": 4_000_000}
_SIZE = (320, 240)


@dataclass(frozen=True)
class TestPair:
    """A rendered reference view, the query image of the same size, and the query's true pose.

    place: pairs of one place are not independent.
    """

    view: RenderedView
    query: Image
    truth: Pose
    condition: str
    place: int = 0


@dataclass(frozen=True)
class MadePlaces:
    """Which generated pairs: split (test or validation), seed (0, 1, 2, ... other places), whether
    map and query share their fine texture, and the folder of the real textures, if any.
    """

    split: str
    seed: int
    shared_detail: bool
    textures: Path | None

    @property
    def name(self) -> str:
        """Folder of these pairs in the cache."""
        kind = "easy" if self.shared_detail else "made"
        return f"{kind}-{self.split}-{self.seed}" + ("" if self.textures else "-untextured")

    @property
    def scenes(self) -> SceneConfig:
        """Size and variety: each place is seen once under every condition."""
        return SceneConfig(
            cells=768,
            width=_SIZE[0],
            height=_SIZE[1],
            photo_share=0.4,
            references=len(MADE_CONDITIONS),
            queries_per_light=1,
            cell_m=(0.25, 0.55),
            conditions=MADE_CONDITIONS,
            motion=(METRES, DEGREES),
            shared_detail=self.shared_detail,
        )


def made_pairs(count: int, which: MadePlaces, cache: Path, workers: int = 2) -> list[TestPair]:
    """Pairs of unseen generated places, conditions in equal shares; written to `cache` once."""
    first = _FIRST_SEED[which.split] + 10_000 * which.seed
    places = range(first, first + round(1.1 * count / len(MADE_CONDITIONS)) + 1)
    folder = cache / which.name
    photos = which.textures and PhotoSource(which.textures, UNSEEN_GROUPS, held_out=True)
    for _ in write_shards(folder, places, which.scenes, photos, workers):
        pass
    pairs: list[TestPair] = []
    for seed in places:
        rng = np.random.default_rng((seed, 1))
        pairs += [_degraded(p, rng, seed) for p in read_shard(shard_path(folder, seed))]
    return pairs[:count]


def mesh_pairs(count: int, seed: int, *, shared_detail: bool) -> list[TestPair]:
    """Pairs of a generated mesh world that no training run has seen."""
    rng = np.random.default_rng((seed, 2))
    scenes = MadePlaces("test", seed, shared_detail, None).scenes
    made = world_pairs(900_000 + seed, scenes, count=count)
    return [_degraded(pair, rng, k) for k, pair in enumerate(made)]


def real_pairs(folder: Path, count: int, seed: int, *, shared_detail: bool) -> list[TestPair]:
    """Pairs on a real map: its own query photos where it has some, else renders; weather is made.

    Without shared detail, vegetation and soil of a rendered query get new fine texture and the
    map's view is coarser than the query; photos differ from their map by themselves.
    """
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as temporary:
        photos = folder / "queries"
        origin = _origin(folder / "georef.json") if photos.exists() else None
        layers = [folder / "dsm.tif", folder / "ortho.tif"]
        cache = Path(temporary) / "cache"
        # Heights only need to agree between map and poses here, so the separation does not matter.
        build_cache(
            layers if layers[0].exists() else folder,
            cache,
            geoid_separation_m=0.0,
            vertical_datum="ellipsoidal",
            origin=origin,
            progress=False,
        )
        with TileStreamer(TileCache.open(cache)) as streamer:
            renderer = NumbaRenderer(streamer)
            if photos.exists():
                return _photo_pairs(renderer, photos, count, rng)
            return _rendered_pairs(renderer, count, rng, shared_detail=shared_detail)


def _degraded(pair: Pair, rng: np.random.Generator, place: int) -> TestPair:
    look = tamed(sample_appearance(rng, pair.condition), pair.query_depth)
    query = apply_appearance(pair.query, pair.query_depth, look, rng)
    view = RenderedView(
        pair.reference, pair.reference_depth, pair.world_from_reference, pair.camera
    )
    kinds = {(True, False): OUTDATED, (False, True): SEASON, (True, True): COMBINED}
    condition = kinds.get((pair.outdated, pair.season), pair.condition)
    return TestPair(view, query, pair.world_from_query, condition, place)


def _photo_pairs(
    renderer: NumbaRenderer, photos: Path, count: int, rng: np.random.Generator
) -> list[TestPair]:
    """Every photo as it is, then under made dusk, night, fog, rain and snow."""
    camera = Camera.from_json(photos / "camera.json").resized(*_SIZE)
    poses = json.loads((photos / "poses.json").read_text())
    names = sorted(p.name for p in (photos / "images").iterdir())
    kinds = ("photo", *(c for c in CONDITIONS if c != "day"))
    pairs = []
    for k in range(count):
        name = names[k % len(names)]
        truth = Pose.from_matrix(poses[name]["T_enu_from_cam"])
        photo = cv2.cvtColor(cv2.imread(str(photos / "images" / name)), cv2.COLOR_BGR2RGB)
        query = cv2.resize(photo, _SIZE, interpolation=cv2.INTER_AREA)
        condition = kinds[k // len(names) % len(kinds)]
        if condition != "photo":
            depth = renderer.render(truth, camera, wait=True).depth
            look = tamed(sample_appearance(rng, condition), depth)
            query = apply_appearance(query, depth, look, rng)
        view = renderer.render(_disturbed(truth, rng), camera, wait=True)
        pairs.append(TestPair(view, query, truth, condition, place=k % len(names)))
    return pairs


def _rendered_pairs(
    renderer: NumbaRenderer, count: int, rng: np.random.Generator, *, shared_detail: bool
) -> list[TestPair]:
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
        query, reference = seen.rgb, view.rgb
        if not shared_detail:
            pixel_m = float(np.median(seen.depth[seen.depth > 0])) / camera.fx
            query = _regrown_image(seen.rgb, pixel_m, rng)
            reference = coarser(view.rgb, draw_texel(rng))
        look = tamed(sample_appearance(rng, condition), seen.depth)
        query = apply_appearance(query, seen.depth, look, rng)
        shown = RenderedView(reference, view.depth, view.world_from_camera, camera)
        pairs.append(TestPair(shown, query, truth, condition, place=len(pairs)))
    return pairs


def _regrown_image(rgb: Image, pixel_m: float, rng: np.random.Generator) -> Image:
    """New fine texture on the soft ground of a rendered view; its pixels stand for ground cells."""
    height, width = rgb.shape[:2]
    below = max(width - height, 0)
    square = cv2.copyMakeBorder(rgb, 0, below, 0, 0, cv2.BORDER_REFLECT)
    albedo: Float32 = square.astype(np.float32) / 255.0
    fresh = regrown(albedo, hard_surfaces(square), pixel_m, rng)[:height, :width]
    return (np.clip(fresh, 0, 1) * 255 + 0.5).astype(np.uint8)


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
