"""Noise and sampling for the painting kernels: a hash of the place, never of the order."""

from __future__ import annotations

import numpy as np
from numba import njit


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
