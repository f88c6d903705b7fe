"""Real test pairs for the feature benchmark: photos, real maps, the same ground in two seasons.

What kind of set a folder holds is seen from its content:

- own photos (`queries/`): each as it is, on a coarser map, on an older map (coarser, and its soft
  ground with another fine texture), and as it is under made dusk, night, fog, rain and snow;
- plots photographed at two dates (`PLOT/*.jpg`): one date is the map, the other the flight. Flat,
  since the orthophotos come without heights; only plots that no training run has seen;
- else a map: queries are its own renders under made weather and season. Vegetation and soil get new
  fine texture and the map's view is coarser than the query, unless detail is shared.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common.maps import build_map, layers_of, origin_of
from benchmarks.features.pairs import DEGREES, METRES, SIZE, TestPair
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.pictures import read_rgb
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import CONDITIONS, weathered
from localizer.synth.visits.visit import coarser, draw_texel, hard_surfaces, with_new_texture
from localizer.training.data.pairs import SEASON, look_at, moved
from localizer.training.places.objects import season_shift
from localizer.types import Float32, Image, RenderedView

PHOTO, COARSE_MAP, OLDER_MAP = "photo", "photo, coarser map", "photo, older map"
_PLOT_TEXEL_M = 0.1
_MADE = tuple(c for c in CONDITIONS if c != "day")


def real_pairs(folder: Path, count: int, seed: int, cache: Path) -> list[TestPair]:
    """Pairs of the real set in `folder`, conditions in turn; its map is built in `cache` once."""
    if (folder / "offsets.csv").exists():
        return _season_pairs(folder, count, seed)
    photos = folder / "queries"
    with TileStreamer(TileCache.open(_map(folder, cache))) as streamer:
        renderer = NumbaRenderer(streamer)
        if photos.exists():
            return _photo_pairs(renderer, photos, count, seed)
        return _rendered_pairs(renderer, count, seed)


def _map(folder: Path, cache: Path) -> Path:
    built = cache / f"map-{folder.name}"
    return built if built.exists() else build_map(layers_of(folder), built, origin_of(folder))


def _photo_pairs(renderer: NumbaRenderer, photos: Path, count: int, seed: int) -> list[TestPair]:
    camera = Camera.from_json(photos / "camera.json").resized(*SIZE)
    poses = json.loads((photos / "poses.json").read_text())
    names = sorted(p.name for p in (photos / "images").iterdir())
    kinds = (PHOTO, COARSE_MAP, OLDER_MAP, *_MADE)
    pairs = []
    for k in range(count):
        rng = np.random.default_rng((seed, k))
        condition, photo = kinds[k % len(kinds)], k // len(kinds) % len(names)
        truth = Pose.from_matrix(poses[names[photo]]["T_enu_from_cam"])
        image = read_rgb(photos / "images" / names[photo])
        query = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
        if condition in _MADE:
            depth = renderer.render(truth, camera, wait=True).depth
            query = weathered(query, depth, condition, rng)
        view = renderer.render(moved(rng, truth, np.inf, (METRES, DEGREES)), camera, wait=True)
        if condition in (COARSE_MAP, OLDER_MAP):
            view = _surveyed(view, rng, repainted=condition == OLDER_MAP)
        pairs.append(TestPair(view, query, truth, condition, place=photo))
    return pairs


def _surveyed(view: RenderedView, rng: np.random.Generator, *, repainted: bool) -> RenderedView:
    """The map's view from a coarser survey, or also an older one: other texture on soft ground."""
    rgb = _regrown_image(view, rng) if repainted else view.rgb
    return RenderedView(
        coarser(rgb, draw_texel(rng)), view.depth, view.world_from_camera, view.camera
    )


def _rendered_pairs(renderer: NumbaRenderer, count: int, seed: int) -> list[TestPair]:
    """Views of the map itself, 80 to 200 m up, under every condition in turn."""
    kinds = (*CONDITIONS, SEASON)
    rng = np.random.default_rng((seed, 1))
    pairs: list[TestPair] = []
    while len(pairs) < count:
        camera = Camera.from_fov(*SIZE, rng.uniform(40, 75))
        truth = _view(rng)
        start = moved(rng, truth, np.inf, (METRES, DEGREES))
        view, seen = (renderer.render(pose, camera, wait=True) for pose in (start, truth))
        if min((view.depth > 0).mean(), (seen.depth > 0).mean()) < 0.8:
            continue
        condition = kinds[len(pairs) % len(kinds)]
        query = _regrown_image(seen, rng)
        view = _surveyed(view, rng, repainted=False)
        if condition == SEASON:
            query = _image(season_shift(_squared(query), rng), query.shape)
        weather = "day" if condition == SEASON else condition
        query = weathered(query, seen.depth, weather, rng)
        pairs.append(TestPair(view, query, truth, condition, place=len(pairs)))
    return pairs


def _regrown_image(view: RenderedView, rng: np.random.Generator) -> Image:
    """New fine texture on the soft ground of a view; its pixels stand for ground cells."""
    pixel_m = float(np.median(view.depth[view.depth > 0])) / view.camera.fx
    albedo = _squared(view.rgb)
    hard = hard_surfaces((albedo * 255).astype(np.uint8))
    return _image(with_new_texture(albedo, hard, pixel_m, rng), view.rgb.shape)


def _squared(rgb: Image) -> Float32:
    """An image wider than high as a square albedo, mirrored below."""
    below = max(rgb.shape[1] - rgb.shape[0], 0)
    square = cv2.copyMakeBorder(rgb, 0, below, 0, 0, cv2.BORDER_REFLECT)
    albedo: Float32 = square.astype(np.float32) / 255.0
    return albedo


def _image(albedo: Float32, shape: tuple[int, ...]) -> Image:
    return (np.clip(albedo[: shape[0], : shape[1]], 0, 1) * 255 + 0.5).astype(np.uint8)


def _view(rng: np.random.Generator) -> Pose:
    pitch = np.radians(rng.uniform(45, 90))
    target = np.array([rng.uniform(-220, 220), rng.uniform(-130, 130), 0.0])
    return look_at(target, rng.uniform(80, 200) / np.sin(pitch), pitch, rng)


def _season_pairs(folder: Path, count: int, seed: int) -> list[TestPair]:
    """A plot at one date as the map and at the other as the flight, 25 to 40 m above it."""
    plots = unseen_plots(folder)
    pairs: list[TestPair] = []
    for k in range(count):
        rng = np.random.default_rng((seed, 3, k))
        plot, dry_map = plots[k // 2 % len(plots)], bool(k % 2)
        dates = [read_rgb(p) for p in plot_dates(plot)]
        surveyed, flown = dates[:: -1 if dry_map else 1]
        view, query, truth = _plot_pair(surveyed, flown, rng)
        seen = np.full(query.shape[:2], truth.translation[2], np.float32)
        query = weathered(query, seen, "day", rng)
        condition = "dry map, green flight" if dry_map else "green map, dry flight"
        pairs.append(TestPair(view, query, truth, condition, place=k // 2 % len(plots)))
    return pairs


def unseen_plots(folder: Path) -> list[Path]:
    """The plots that no training run has seen."""
    return sorted(p for p in folder.iterdir() if p.is_dir())[3::4]


def plot_dates(plot: Path) -> list[Path]:
    """The green date, then the dry one."""

    def green(path: Path) -> float:
        red_green_blue = read_rgb(path).reshape(-1, 3).mean(0)
        return float(red_green_blue[0] - red_green_blue[1])

    return sorted(plot.glob("*.jpg"), key=green)


def _plot_pair(
    surveyed: Image, flown: Image, rng: np.random.Generator
) -> tuple[RenderedView, Image, Pose]:
    """Two views of flat ground: all of the query and four fifths of the map's view lie on it."""
    while True:
        camera = Camera.from_fov(*SIZE, rng.uniform(35, 50))
        pitch = np.radians(rng.uniform(65, 90))
        at = rng.uniform(-12, 12, 2)
        truth = look_at(np.array([*at, 0.0]), rng.uniform(25, 40) / np.sin(pitch), pitch, rng)
        start = moved(rng, truth, np.inf, (METRES, DEGREES))
        query, depth = plane_view(flown, truth, camera)
        if not (depth > 0).all():
            continue
        reference, depth = plane_view(surveyed, start, camera)
        if (depth > 0).mean() >= 0.8:
            return RenderedView(reference, depth, start, camera), query, truth


def plane_view(ortho: Image, pose: Pose, camera: Camera) -> tuple[Image, Float32]:
    """View of a square orthophoto lying at z = 0 around the origin; black, depth 0 beside it."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = camera.rays(np.stack([u, v], -1))
    along = rays @ pose.rotation[2]
    depth = np.where(along < 0, -pose.translation[2] / np.minimum(along, -1e-9), 0.0)
    ground = pose.apply(rays * depth[..., None])
    side = ortho.shape[0]
    col = side / 2 + ground[..., 0] / _PLOT_TEXEL_M
    row = side / 2 - ground[..., 1] / _PLOT_TEXEL_M
    on = (along < 0) & (np.abs(col - side / 2) < side / 2) & (np.abs(row - side / 2) < side / 2)
    image = cv2.remap(
        ortho,
        (col - 0.5).astype(np.float32),
        (row - 0.5).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    image[~on] = 0
    return image, np.where(on, depth, 0.0).astype(np.float32)
