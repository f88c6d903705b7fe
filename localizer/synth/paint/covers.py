"""What the painting kernels share: covers, facade styles, light, and how a texel is coloured.

Every texel knows its place in the world, and noise is a hash of that place, so textures do not
repeat, tiles join without seams, and two visits differ only in what the `VisitLook` says. Colours
are sRGB values used as albedo; light is ``sky * ambient_occlusion + sun * cos(angle) * lit``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.types import Image


class Cover(IntEnum):
    """What a building surface is made of; the kernel knows each by this number."""

    PLAIN = 0
    FACADE = 1
    TILES = 2
    GRAVEL = 3
    BITUMEN = 4
    METAL = 5
    GREEN = 6
    GLASS = 7
    DECK = 8  # car-park deck with bays
    SLATE = 9
    HEDGE = 10


class FacadeStyle(IntEnum):
    """Window layout and wall structure of a facade."""

    HOUSE = 0
    APARTMENT = 1
    HALL = 2
    CHURCH = 3
    OFFICE = 4
    BARN = 5
    BLANK = 6
    BRICK = 7


@dataclass(frozen=True)
class WindowLight:
    """Light of one window of the world. ceiling: (h, w) float32 height below which a point is in
    shadow; ambient: (h, w) float32 visible share of the sky at the ground; top-left corner (west,
    north), `gsd_m` per pixel; sun: unit vector (3,); season: dryness, crop, leaf.
    """

    ceiling: NDArray[np.float32]
    ambient: NDArray[np.float32]
    west: float
    north: float
    gsd_m: float
    sun: NDArray[np.float32]
    sun_rgb: NDArray[np.float32]
    sky_rgb: NDArray[np.float32]
    season: NDArray[np.float32]


def new_image(height: int, width: int) -> Image:
    """An RGB image to paint all over: its pixels are arbitrary."""
    return np.empty((height, width, 3), np.uint8)


@njit(cache=True, nogil=True, inline="always")
def hash01(ix, iy, seed):  # type: ignore[no-untyped-def]
    """Random number in [0, 1) of a lattice point; equal arguments give equal numbers."""
    h = (ix * 374761393 + iy * 668265263 + seed * 974634421) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFFFF) * (1.0 / 16777216.0)


@njit(cache=True, nogil=True, inline="always")
def noise(x, y, seed):  # type: ignore[no-untyped-def]
    """Value noise in [-0.5, 0.5], one lattice cell per unit."""
    fx, fy = np.floor(x), np.floor(y)
    ix, iy = int(fx), int(fy)
    tx, ty = x - fx, y - fy
    tx, ty = tx * tx * (3 - 2 * tx), ty * ty * (3 - 2 * ty)
    a, b = hash01(ix, iy, seed), hash01(ix + 1, iy, seed)
    c, d = hash01(ix, iy + 1, seed), hash01(ix + 1, iy + 1, seed)
    return (a + tx * (b - a)) * (1 - ty) + (c + tx * (d - c)) * ty - 0.5


@njit(cache=True, nogil=True, inline="always")
def smooth_step(x, low, high):  # type: ignore[no-untyped-def]
    """0 up to `low`, 1 from `high` on, smooth between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3 - 2 * t)


@njit(cache=True, nogil=True, inline="always")
def bilinear(grid, u, v):  # type: ignore[no-untyped-def]
    """Sample at column u, row v (sample centres at integers), clamped."""
    h, w = grid.shape
    u = min(max(u, 0.0), w - 1.001)
    v = min(max(v, 0.0), h - 1.001)
    i, j = int(v), int(u)
    fu, fv = u - j, v - i
    top = grid[i, j] + fu * (grid[i, j + 1] - grid[i, j])
    low = grid[i + 1, j] + fu * (grid[i + 1, j + 1] - grid[i + 1, j])
    return top + fv * (low - top)


@njit(cache=True, nogil=True, inline="always")
def as_byte(x):  # type: ignore[no-untyped-def]
    """A colour value, clipped to 0..255 and cut to uint8."""
    return np.uint8(min(max(x, 0.0), 255.0))
