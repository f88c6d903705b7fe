"""Relief: a valley with a river, hills on both sides, as a height grid and its exact surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from localizer.geometry.pose import Array
from localizer.synth.config import TERRAIN_SPACING_M, WorldConfig

_RIVER_STEP_M = 2.0
_BANK_M = 9.0  # from the water's edge to the top of the bank
_BANK_HEIGHT_M = 1.8


@dataclass(frozen=True)
class River:
    """points: (N, 2) ENU metres along the middle; width: (N,) and level: (N,) in metres."""

    points: Array
    width: Array
    level: Array

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    def distance(self, xy: ArrayLike) -> tuple[Array, NDArray[np.intp]]:
        """Distance (...,) in metres from points (..., 2) to the middle line, and nearest index."""
        distance, index = self._tree.query(np.asarray(xy))
        return np.asarray(distance), np.asarray(index)


@dataclass(frozen=True)
class Terrain:
    """The world's terrain. heights: (n, n) float32 metres, row 0 = south, column 0 = west,
    `spacing_m` apart.

    The surface is the grid's triangles with the diagonal from south-west to north-east; the finest
    tiles consist of exactly these triangles.
    """

    heights: NDArray[np.float32]
    spacing_m: float
    river: River

    @property
    def half_m(self) -> float:
        """Half the side length in metres."""
        half: float = (self.heights.shape[0] - 1) * self.spacing_m / 2
        return half

    def height(self, east: ArrayLike, north: ArrayLike) -> Array:
        """Height of the surface in metres; outside the grid that of the nearest edge."""
        n = self.heights.shape[0]
        c = np.clip((np.asarray(east, float) + self.half_m) / self.spacing_m, 0, n - 1)
        r = np.clip((np.asarray(north, float) + self.half_m) / self.spacing_m, 0, n - 1)
        ci = np.minimum(c.astype(int), n - 2)
        ri = np.minimum(r.astype(int), n - 2)
        fx, fy = c - ci, r - ri
        h = self.heights.astype(np.float64)
        sw, se = h[ri, ci], h[ri, ci + 1]
        nw, ne = h[ri + 1, ci], h[ri + 1, ci + 1]
        lower = sw + fx * (se - sw) + fy * (ne - se)
        upper = sw + fy * (nw - sw) + fx * (ne - nw)
        return np.asarray(np.where(fx >= fy, lower, upper))

    def gradient(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Slope to the east and to the north on the grid, each (n, n)."""
        north, east = np.gradient(self.heights, self.spacing_m)
        return np.asarray(east, np.float32), np.asarray(north, np.float32)


def smoothstep(x: ArrayLike, low: float, high: float) -> Array:
    """Hermite step from 0 at `low` to 1 at `high`."""
    t = np.clip((np.asarray(x, float) - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def smooth_noise(rng: np.random.Generator, n: int, wavelength: float) -> Array:
    """Noise (n, n) of zero mean and unit deviation; `wavelength` in samples."""
    m = max(4, int(np.ceil(n / wavelength)) + 4)
    coarse = rng.standard_normal((m, m)).astype(np.float32)
    step = max(1, round(wavelength))
    fine = cv2.resize(coarse, (m * step, m * step), interpolation=cv2.INTER_CUBIC)
    fine = cv2.GaussianBlur(fine, (0, 0), max(0.8, wavelength * 0.3))
    out = fine[step : step + n, step : step + n].astype(np.float64)
    return np.asarray((out - out.mean()) / max(float(out.std()), 1e-6))


def make_river(config: WorldConfig) -> River:
    """A meandering river beside the town, with one reach widened to a lake."""
    rng = config.rng(1)
    reach = 1600.0 if config.size_m > 800 else config.size_m * 2.0
    angle = rng.uniform(0, 2 * np.pi)
    offset = rng.uniform(0.26, 0.32) * reach * rng.choice([-1.0, 1.0])
    along = np.arange(-1.0 * reach, 1.0 * reach, _RIVER_STEP_M)
    meander = 45.0 * np.sin(2 * np.pi * along / 610.0 + rng.uniform(0, 6.3))
    meander += 16.0 * np.sin(2 * np.pi * along / 233.0 + rng.uniform(0, 6.3))
    across = offset + meander
    direction = np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([-direction[1], direction[0]])
    points = along[:, None] * direction + across[:, None] * normal
    lake_at = rng.uniform(-0.25, 0.25) * reach
    width = 17.0 + 3.0 * np.sin(along / 90.0)
    width += 75.0 * np.exp(-(((along - lake_at) / 85.0) ** 2))
    # The water falls along the stream, and stands level in the lake.
    fall = np.where(np.abs(along - lake_at) < 150.0, 0.0, 0.004 * _RIVER_STEP_M)
    return River(points, width, -np.cumsum(fall) - 6.0)


def make_terrain(config: WorldConfig) -> Terrain:
    """The height grid of a world: valley, hills, carved river; 0 m at the middle of the world."""
    rng = config.rng(2)
    river = make_river(config)
    n = round(config.size_m / TERRAIN_SPACING_M) + 1
    axis = np.linspace(-config.half_m, config.half_m, n)
    x, y = np.meshgrid(axis, axis)
    distance, nearest = river.distance(np.stack([x, y], -1).reshape(-1, 2))
    distance, nearest = distance.reshape(n, n), nearest.reshape(n, n)
    bank = distance - river.width[nearest] / 2

    wave = 1.0 / TERRAIN_SPACING_M
    hills = smooth_noise(rng, n, 420 * wave) + 0.35 * smooth_noise(rng, n, 170 * wave)
    hills += 0.06 * smooth_noise(rng, n, 45 * wave)
    valley = smoothstep(bank, 60.0, 60.0 + 0.55 * max(config.size_m, 800.0))
    target = config.relief_m
    if target is None:
        target = rng.uniform(72, 95) * min(1.0, 0.35 + 0.65 * config.size_m / 1600.0)
    shape = 0.75 * valley + 0.13 * hills * smoothstep(bank, 0.0, 220.0)
    shape *= target / float(np.ptp(shape))

    # Smooth the water level across the valley so that the nearest-point jump leaves no ridge.
    level = cv2.GaussianBlur(river.level[nearest].astype(np.float32), (0, 0), 60 * wave)
    near = np.exp(-((np.maximum(bank, 0) / 60.0) ** 2))
    base = near * river.level[nearest] + (1 - near) * level
    land = base + shape + _BANK_HEIGHT_M * smoothstep(bank, 0.0, _BANK_M)
    heights = np.where(bank <= 0, river.level[nearest], land)
    middle = heights[n // 2, n // 2]
    lowered = River(river.points, river.width, river.level - middle)
    return Terrain((heights - middle).astype(np.float32), TERRAIN_SPACING_M, lowered)
