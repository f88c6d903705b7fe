"""The sets of the integrity benchmark: maps with query views, kept in a folder between runs.

"tuning", "generated" and "unseen" are worlds of different seeds. The made maps are hard on purpose:
forest (few photographs of crowns, turned and mirrored, over and over), water (nothing but waves,
others in the query), roofs (one house on equal lots), "outdated" (portugal, of which three squares
in ten show other ground, heights included), "shifted" (portugal's orthophoto 5 m off its heights).
"fengyuan" and "neon" are real photos over maps of another date (`benchmarks.real.sets`). "dark ..."
is another set's first views in ever less light, until the sensor's noise is all that is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.transform import Affine

from benchmarks.basin.views import (
    SIZE,
    VIEWS_PER_WORLD,
    BasinView,
    load_kept,
    load_views,
    store_renders,
)
from benchmarks.common.maps import build_map, write_raster
from benchmarks.real.sets import load
from localizer.pictures import read_rgb
from localizer.types import Float32, Image
from sitl.camera.faults import darken

TUNING = "tuning"  # thresholds may be chosen on it, figures are those of the others
UNSEEN = "unseen"  # two more worlds, made and run only when asked for: nobody has seen them before
SETS = {
    TUNING: 40, "generated": 40, "quito": 40, "portugal": 40, "caliterra": 50, "outdated": 30,
    "shifted": 20, "forest": 30, "water": 15, "roofs": 30, "fengyuan": 32, "neon": 32, UNSEEN: 80,
}  # fmt: skip
_WORLDS = (TUNING, "generated", UNSEEN)  # each begins with another world
DARK = "dark "
SETS |= {DARK + name: 12 for name in SETS if name not in (TUNING, UNSEEN, "shifted", "water")}
# Share of the light and largest gain, in turns.
_LIGHTS = (
    (1 / 1024, 16.0), (1 / 2048, 16.0), (1 / 4096, 16.0), (1 / 8192, 16.0), (1 / 256, 1.0),
    (1 / 4096, 1.0),
)  # fmt: skip
_CHANGED, _CHANGE_M = 0.3, 24.0  # share of an outdated map that has changed, side of a change
SHIFT_M = (4.0, -3.0)  # of the orthophoto, east and north
_SIDE_M, _GSD_M, _POST_M = 480.0, 0.2, 0.8  # of a made map, its picture and its heights
_HALF_M = 140.0  # within which its views look
_CORNER, _CRS = (465_000.0, 5_250_000.0), "EPSG:32632"


def load_set(name: str, folder: Path, data: Path, count: int) -> list[BasinView]:
    """The views of a set, made on the first call; a few photos are given again."""
    if name.startswith(DARK):
        return _darkened(load_set(name.removeprefix(DARK), folder, data, count))
    home = folder / name
    if name in _WORLDS:
        first = VIEWS_PER_WORLD * _WORLDS.index(name)
        return load_views("generated", folder, data, first + count)[first:]
    if name in ("quito", "portugal", "caliterra"):
        views = load_views(name, folder, data, count)
        return (views * -(-count // len(views)))[:count]
    if name in ("fengyuan", "neon"):
        return [view.at_width(SIZE[0]) for view in load(name, folder, data)[:count]]
    if not (home / "views.npz").exists():
        home.mkdir(parents=True, exist_ok=True)
        {"outdated": _outdated, "shifted": _shifted}.get(name, _made)(home, folder, data, count)
    return load_kept(home)[:count]


def _darkened(views: list[BasinView]) -> list[BasinView]:
    dark = []
    for k, view in enumerate(views):
        rng = np.random.default_rng((41, k))
        dark.append(replace(view, query=darken(view.query, *_LIGHTS[k % len(_LIGHTS)], rng)))
    return dark


def shift_of(name: str) -> tuple[float, float]:
    """How far a set's picture lies from its heights, metres east and north."""
    return SHIFT_M if name == "shifted" else (0.0, 0.0)


def place_of(view: BasinView) -> Path:
    """What tells places apart: the folder of the map, or of the one that it was made from."""
    home = view.map_cache.parent
    return home.parent / "portugal" if home.name in ("shifted", "outdated") else home


def _outdated(home: Path, folder: Path, data: Path, count: int) -> None:
    """Portugal with squares exchanged for others of it; queries from the map as it is."""
    load_views("portugal", folder, data, count)
    rng = np.random.default_rng(5)
    sources = [home / "dsm.tif", home / "ortho.tif"]
    with rasterio.open(data / "portugal" / "dsm.tif") as heights:
        bounds = heights.bounds
    west, north = np.meshgrid(
        np.arange(bounds.left, bounds.right - _CHANGE_M, _CHANGE_M),
        np.arange(bounds.top, bounds.bottom + _CHANGE_M, -_CHANGE_M),
    )
    corners = np.stack([west.ravel(), north.ravel()], axis=1)
    new = rng.permutation(len(corners))[: round(_CHANGED * len(corners))]
    old = rng.permutation(len(corners))[: len(new)]
    for out in sources:
        with rasterio.open(data / "portugal" / out.name) as given:
            profile, array = given.profile, given.read()
            side = round(_CHANGE_M / given.res[0])
            cells = [given.index(*corner) for corner in corners]
        changed = array.copy()
        for to, source in zip(new, old, strict=True):
            (i, j), (k, m) = cells[int(to)], cells[int(source)]
            h, w = (min(side, array.shape[a] - max(b, c)) for a, b, c in ((1, i, k), (2, j, m)))
            changed[:, i : i + h, j : j + w] = array[:, k : k + h, m : m + w]
        with rasterio.open(out, "w", **profile) as file:
            file.write(changed)
    build_map(sources, home / "map.cache")
    true = folder / "portugal" / "map.cache"
    store_renders(home, home / "map.cache", true, (100.0, 110.0), rng, count)


def _shifted(home: Path, folder: Path, data: Path, count: int) -> None:
    """Portugal with its orthophoto moved against its heights; queries from the map as it is."""
    load_views("portugal", folder, data, count)
    source = data / "portugal"
    with rasterio.open(source / "ortho.tif") as ortho:
        profile = ortho.profile | {"transform": Affine.translation(*SHIFT_M) @ ortho.transform}
        with rasterio.open(home / "ortho.tif", "w", **profile) as moved:
            moved.write(ortho.read())
    cache = home / "map.cache"
    build_map([source / "dsm.tif", home / "ortho.tif"], cache)
    true = folder / "portugal" / "map.cache"
    rng = np.random.default_rng(3)
    store_renders(home, cache, true, (100.0, 110.0), rng, count)


def _made(home: Path, _folder: Path, data: Path, count: int) -> None:
    """A made map, and, where the ground itself moves, another one that the queries see."""
    paint: Callable[[Path, int], tuple[Image, Float32]] = {
        "forest": _forest, "water": _water, "roofs": _roofs,
    }[home.name]  # fmt: skip
    moves = home.name == "water"
    for name, seed in (("map", 0), ("day", 1)) if moves else (("map", 0),):
        rgb, height = paint(data, seed)
        sources = [home / f"{name}-dsm.tif", home / f"{name}-ortho.tif"]
        write_raster(sources[0], height[None], _POST_M, _CRS, _CORNER)
        write_raster(sources[1], rgb.transpose(2, 0, 1), _GSD_M, _CRS, _CORNER)
        build_map(sources, home / f"{name}.cache")
    day = home / ("day.cache" if moves else "map.cache")
    rng = np.random.default_rng(11)
    store_renders(home, home / "map.cache", day, (_HALF_M, _HALF_M), rng, count)


def _noise(rng: np.random.Generator, side: int, wave_px: float) -> Float32:
    """Smooth noise (side, side) of sigma 1."""
    coarse = max(4, round(side / wave_px))
    small = rng.standard_normal((coarse, coarse)).astype(np.float32)
    full = cv2.resize(small, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.asarray(full / full.std(), np.float32)


def _posts(height: Float32) -> Float32:
    side = round(_SIDE_M / _POST_M)
    return np.asarray(cv2.resize(height, (side, side), interpolation=cv2.INTER_AREA), np.float32)


def _forest(data: Path, seed: int) -> tuple[Image, Float32]:
    """Crowns of the NEON plots (40 m, 0.1 m a pixel, CC0), as heights by their brightness."""
    rng = np.random.default_rng((21, seed))
    plots = sorted((data / "textures" / "neon_forest").glob("HARV_*.jpg"))[:12]
    side, part = round(_SIDE_M / _GSD_M), round(40.0 / _GSD_M)
    rgb = np.zeros((side, side, 3), np.uint8)
    pictures = [cv2.resize(read_rgb(p), (part, part), interpolation=cv2.INTER_AREA) for p in plots]
    for i in range(0, side, part):
        for j in range(0, side, part):
            tile = np.rot90(pictures[int(rng.integers(len(pictures)))], int(rng.integers(4)))
            tile = tile[:, ::-1] if rng.random() < 0.5 else tile
            rgb[i : i + part, j : j + part] = tile[: side - i, : side - j]
    grey = cv2.GaussianBlur(rgb.astype(np.float32).mean(axis=2), (0, 0), 4.0)
    height = 18.0 + 2.0 * (grey - grey.mean()) / grey.std() + 3.0 * _noise(rng, side, 400)
    return rgb, _posts(height.astype(np.float32))


def _water(_data: Path, seed: int) -> tuple[Image, Float32]:
    rng = np.random.default_rng((22, seed))
    side = round(_SIDE_M / _GSD_M)
    waves = 5.0 * _noise(rng, side, 12) + 3.0 * _noise(rng, side, 60) + 3.0 * _noise(rng, side, 500)
    rgb = np.array([38.0, 62.0, 70.0]) + waves[..., None]
    return rgb.clip(0, 255).astype(np.uint8), np.zeros((round(_SIDE_M / _POST_M),) * 2, np.float32)


def _roofs(_data: Path, seed: int) -> tuple[Image, Float32]:
    """A colony of one house: lots of 24 by 20 m, a road every fourth row, a tree in a third."""
    rng = np.random.default_rng((23, seed))
    side = round(_SIDE_M / _GSD_M)
    lawn = np.array([96.0, 112.0, 72.0]) + 6.0 * _noise(rng, side, 8)[..., None]
    height = np.zeros((side, side), np.float32)
    lot_x, lot_y = round(24 / _GSD_M), round(20 / _GSD_M)
    for row, y in enumerate(range(0, side, lot_y)):
        if row % 4 == 0:
            lawn[y : y + lot_y // 3] = (118, 116, 112)
        for x in range(0, side, lot_x):
            house = np.s_[y + lot_y // 2 : y + lot_y - 6, x + 15 : x + 75]
            depth = lawn[house].shape[0]
            lawn[house] = np.array([150.0, 82.0, 62.0])
            lawn[house][: depth // 2] *= 0.78  # the roof's other slope
            height[house] = 6.0
            if rng.random() < 0.33:
                at = (int(rng.integers(x + 80, x + 110)), int(rng.integers(y + 30, y + 80)))
                cv2.circle(lawn, at, 14, (52.0, 78.0, 40.0), -1)
                cv2.circle(height, at, 14, 7.0, -1)
    return lawn.clip(0, 255).astype(np.uint8), _posts(height)
