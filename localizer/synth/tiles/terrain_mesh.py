"""The terrain of a tile as a mesh with a skirt."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.synth.plan.terrain import Terrain


def terrain_mesh(
    terrain: Terrain, west: float, north: float, side: float, step: int
) -> tuple[Array, Array, NDArray[np.int64], float]:
    """Terrain of a square tile from every `step`-th grid node, with a skirt.

    Returns positions (V, 3), place in the tile (V, 2) as a share of its side (right, down), faces
    (F, 3), and the largest vertical deviation from the full grid in metres.
    """
    spacing, half = terrain.spacing_m, terrain.half_m
    c0, r0 = round((west + half) / spacing), round((north - side + half) / spacing)
    cells = round(side / spacing)
    fine = terrain.heights[r0 : r0 + cells + 1, c0 : c0 + cells + 1].astype(np.float64)
    grid = fine[::step, ::step]
    coarse = Terrain(grid.astype(np.float32), spacing * step, terrain.river)
    axis = np.linspace(-side / 2, side / 2, cells + 1)
    fx, fy = np.meshgrid(axis, axis)
    error = float(np.abs(coarse.height(fx, fy) - fine).max())

    n = grid.shape[0]
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    top = np.stack([west + x * side, north - side + y * side, grid], -1).reshape(-1, 3)
    share = np.stack([x, 1 - y], -1).reshape(-1, 2)
    index = np.arange(n * n).reshape(n, n)
    sw, se, nw, ne = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    lower, upper = np.stack([sw, se, ne], -1), np.stack([sw, ne, nw], -1)
    faces = [lower.reshape(-1, 3), upper.reshape(-1, 3)]

    # Neighbours of another level may lie lower by both their errors.
    depth = 1.0 + 0.05 * spacing * step + 2 * error
    ring = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    skirt = top[ring] - [0, 0, depth]
    a, b = ring, np.roll(ring, -1)
    low_a = n * n + np.arange(len(ring))
    low_b = np.roll(low_a, -1)
    faces += [np.stack([a, low_a, low_b], -1), np.stack([a, low_b, b], -1)]
    return (
        np.concatenate([top, skirt]),
        np.concatenate([share, share[ring]]),
        np.concatenate(faces).astype(np.int64),
        error,
    )
