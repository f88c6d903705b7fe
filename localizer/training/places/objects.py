"""Objects of training places, drawn at random, and the surface that photogrammetry leaves.

The surface is rounded, bumpy, without windows. What the ground's texture becomes between two visits
is `localizer.synth.visits.visit`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.synth.heightfield.scene import Land, LitScene, Prism, block_maxima
from localizer.synth.visits.visit import noise
from localizer.types import Float32


@dataclass(frozen=True)
class TrainingPlace:
    """A training place: ground, prisms (buildings and plants) on it and roads. seasons: albedos of
    the same ground at other dates, where the data has them. lasting: (n, n) in 0..1, one where the
    fine texture is the same at all dates: roads, roofs, pavement.
    """

    land: Land
    prisms: list[Prism]
    roads: list[Float32]
    lasting: Float32
    seasons: tuple[Float32, ...] = ()


def parked_cars(rng: np.random.Generator, place: TrainingPlace, count: int) -> list[Prism]:
    """Cars beside roads, or anywhere if the place has no roads."""
    n, cell = place.land.height.shape[0], place.land.cell_m
    cars = []
    for _ in range(count):
        at, angle = rng.uniform(0, n, 2), rng.uniform(0, np.pi)
        if place.roads:
            road = place.roads[int(rng.integers(len(place.roads)))]
            k = int(rng.integers(len(road) - 1))
            step = road[k + 1] - road[k]
            angle = float(np.arctan2(step[1], step[0]))
            side = np.array([-np.sin(angle), np.cos(angle)]) * rng.choice((-1, 1)) * 2.2 / cell
            at = road[k] + rng.random() * step + side
        size = (4.5 / cell, 1.9 / cell) if rng.random() < 0.9 else (9.0 / cell, 2.5 / cell)
        paint = rng.uniform(0.05, 0.9) + rng.normal(0, 0.12, 3)
        color = tuple(np.clip(paint, 0.03, 0.95).tolist())
        cars.append(Prism(_box(at, size, angle), 1.5, 0.0, color, color, 0.0))
    return cars


def new_buildings(rng: np.random.Generator, place: TrainingPlace, count: int) -> list[Prism]:
    """Buildings at random places, as built since the survey."""
    n, cell = place.land.height.shape[0], place.land.cell_m
    return [building(rng, rng.uniform(0, n, 2), rng.uniform(0, np.pi), cell) for _ in range(count)]


def buildings_along(
    rng: np.random.Generator,
    roads: list[Float32],
    n: int,
    cell_m: float,
    town: NDArray[np.bool_],
) -> list[Prism]:
    """Buildings beside roads, close together where `town` (n, n) is true; none overlap."""
    buildings: list[Prism] = []
    taken = np.zeros((n, n), np.uint8)
    for road in roads:
        cv2.polylines(taken, [np.rint(road).astype(np.int32)], False, 1, max(int(8 / cell_m), 1))
    pace = rng.uniform(14, 30)
    for road in roads:
        length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(road, axis=0), axis=1))]
        for d in np.arange(0, length[-1], pace / cell_m):
            if len(buildings) >= 900:
                return buildings
            k = int(np.clip(np.searchsorted(length, d) - 1, 0, len(road) - 2))
            step = (road[k + 1] - road[k]) / max(float(length[k + 1] - length[k]), 1e-6)
            side = np.array([-step[1], step[0]]) * rng.choice((-1, 1))
            at = road[k] + (d - length[k]) * step + side * rng.uniform(11, 22) / cell_m
            col, row = int(at[0]), int(at[1])
            if not (0 <= col < n and 0 <= row < n):
                continue
            if rng.random() > (0.85 if town[row, col] else 0.08):
                continue
            b = building(rng, at, float(np.arctan2(step[1], step[0])), cell_m)
            mask = np.zeros_like(taken[:1, :1])
            lo = np.floor(b.corners.min(0)).astype(int).clip(0, n - 1)
            hi = np.ceil(b.corners.max(0)).astype(int).clip(1, n) + 1
            window = taken[lo[1] : hi[1], lo[0] : hi[0]]
            mask = np.zeros_like(window)
            cv2.fillConvexPoly(mask, np.rint(b.corners - lo).astype(np.int32), 1)
            if (window & mask).any():
                continue
            window |= mask
            buildings.append(b)
    return buildings


def building(
    rng: np.random.Generator, at: NDArray[np.float64], angle: float, cell_m: float
) -> Prism:
    """A building at a place in cells, its long side at an angle: mostly houses, some tall."""
    size = np.exp(rng.normal(np.log((14.0, 10.0)), 0.35)) / cell_m
    tall = rng.random() < 0.15
    height = rng.uniform(12, 40) if tall else rng.uniform(3, 10)
    tone = rng.uniform(0.2, 0.8)
    hues = ((1, 1, 1), (1.15, 0.75, 0.6), (0.85, 0.9, 1.0), (1.05, 0.95, 0.8))
    roof = tone * np.array(hues[int(rng.integers(4))]) + rng.normal(0, 0.03, 3)
    wall = rng.uniform(0.35, 0.85) * np.array((1.0, rng.uniform(0.85, 1), rng.uniform(0.7, 1)))
    return Prism(
        _box(at, (float(size[0]), float(size[1])), angle),
        float(height),
        0.0 if tall or rng.random() < 0.35 else float(rng.uniform(1.5, 4.0)),
        tuple(np.clip(roof, 0.05, 0.95).tolist()),
        tuple(np.clip(wall, 0.05, 0.95).tolist()),
        float(rng.uniform(2.0, 4.5)),
    )


def with_ground_color(prism: Prism, texture: NDArray[np.uint8], rng: np.random.Generator) -> Prism:
    """The building with a roof in the texture's own colour at its middle."""
    n = texture.shape[0]
    col, row = np.clip(prism.corners.mean(0), 0, n - 1).astype(int)
    color = texture[row, col] / 255.0 * rng.uniform(0.6, 1.6)
    roof = tuple(np.clip(color, 0.05, 0.95).tolist())
    return Prism(prism.corners, prism.height_m, prism.ridge_m, roof, prism.wall, prism.window_m)


def _box(
    at: NDArray[np.float64] | NDArray[np.float32], size: tuple[float, float], angle: float
) -> Float32:
    c, s = np.cos(angle), np.sin(angle)
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(size) / 2
    corners: Float32 = (half @ np.array([[c, s], [-s, c]]) + at).astype(np.float32)
    return corners


def plant(
    rng: np.random.Generator,
    height: Float32,
    albedo: Float32,
    forest: NDArray[np.bool_],
    blocked: NDArray[np.uint8],
    cell_m: float,
) -> None:
    """Draw tree crowns as domes, in place: dense in the forest, scattered elsewhere."""
    n = height.shape[0]
    budget = int(min(5000, 0.02 * n * n))
    at = rng.uniform(0, n, (budget, 2))
    chance = np.where(forest[at[:, 1].astype(int), at[:, 0].astype(int)], 1.0, 0.05)
    chance[blocked[at[:, 1].astype(int), at[:, 0].astype(int)] > 0] = 0.0
    ground = height.copy()
    for x, y in at[rng.random(budget) < chance]:
        radius = max(rng.uniform(1.8, 5.0) / cell_m, 1.6)
        x0, x1 = int(max(x - radius, 0)), int(min(x + radius + 2, n))
        y0, y1 = int(max(y - radius, 0)), int(min(y + radius + 2, n))
        dx = (np.arange(x0, x1) - x)[None] / radius
        dy = (np.arange(y0, y1) - y)[:, None] / radius
        dome = 1 - dx**2 - dy**2
        inside = dome > 0
        top = ground[int(y), int(x)] + radius * cell_m * (0.8 + 1.2 * np.sqrt(np.maximum(dome, 0)))
        patch = height[y0:y1, x0:x1]
        inside &= top > patch
        patch[inside] = top[inside]
        green = np.array([0.17, 0.27, 0.11]) * rng.uniform(0.6, 1.5) + rng.normal(0, 0.015, 3)
        shade = rng.uniform(0.75, 1.25, inside.shape)[..., None]
        albedo[y0:y1, x0:x1][inside] = (green * shade)[inside]


_MESH_M = (0.3, 2.0)  # horizontal resolution of a photogrammetric surface
_BUMPS_M = (0.03, 0.25)  # its vertical noise


def coarse_mesh(scene: LitScene, rng: np.random.Generator) -> LitScene:
    """The scene's height field as photogrammetry gives it: rounded edges and bumps. Prisms stay as
    they are. The side of the height field, in cells, must be a multiple of `BLOCK`.
    """
    n, cell = scene.height.shape[0], scene.cell_m
    factor = float(np.exp(rng.uniform(*np.log(_MESH_M)))) / cell
    height = scene.height
    if factor > 1.0:
        side = max(int(n / min(factor, 6.0)), 64)
        small = cv2.resize(height, (side, side), interpolation=cv2.INTER_AREA)
        height = cv2.resize(small, (n, n), interpolation=cv2.INTER_LINEAR)
    bumps = noise(n, rng, max(int(n * cell / 8.0), 4), 2, 0.5)
    height = (height + np.float32(rng.uniform(*_BUMPS_M)) * bumps).astype(np.float32)
    return replace(scene, height=height, block_max=block_maxima(height))


def plain_walls(prisms: list[Prism]) -> list[Prism]:
    """The buildings as seen from above only: walls without windows."""
    return [replace(p, window_m=0.0) for p in prisms]


Color = tuple[float, float, float]


def season_shift(albedo: Float32, rng: np.random.Generator) -> Float32:
    """The ground at another time of the year: vegetation recoloured, tones remapped, wetness."""
    red, green, blue = albedo[..., 0], albedo[..., 1], albedo[..., 2]
    leafy = np.clip((green - np.maximum(red, blue)) * 9.0, 0, 1)[..., None]
    kind = rng.choice(4)
    targets: tuple[Color, ...] = ((0.52, 0.45, 0.26), (0.5, 0.3, 0.12), (0.2, 0.36, 0.1))
    out = albedo
    if kind < 3:
        gray = albedo.mean(-1, keepdims=True)
        target = np.asarray(targets[kind], np.float32) * (gray / 0.3) ** rng.uniform(0.3, 1.0)
        mix = np.float32(rng.uniform(0.2, 0.9))
        patches = np.clip(0.7 + 0.4 * noise(albedo.shape[0], rng, 6, 3, 0.6), 0, 1)[..., None]
        out = out + leafy * mix * patches * (target - out)
    if rng.random() < 0.6:
        out = _remap(out, rng)
    gain = 1.0 + 0.12 * noise(albedo.shape[0], rng, 4, 4, 0.6)[..., None]
    return np.clip(out * gain, 0.02, 1.2).astype(np.float32)


def _remap(albedo: Float32, rng: np.random.Generator) -> Float32:
    """A smooth random change of tones and hues."""
    mix = np.eye(3) + rng.normal(0, 0.1, (3, 3))
    mixed = np.clip(albedo.reshape(-1, 3) @ mix.astype(np.float32), 0, 1).reshape(albedo.shape)
    knots = np.linspace(0, 1, 6)
    grid = np.linspace(0, 1, 256)
    out = np.empty_like(albedo)
    shared = rng.normal(0, 0.08, 6)
    indices = (mixed * 255).astype(np.uint8)
    for c in range(3):
        curve = np.interp(grid, knots, knots + shared + rng.normal(0, 0.04, 6))
        out[..., c] = curve.astype(np.float32)[indices[..., c]]
    return out
