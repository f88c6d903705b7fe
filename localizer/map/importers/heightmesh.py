"""Makes meshes from height grids, for rasters and for generated coarse levels."""

from __future__ import annotations

import fast_simplification
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array

REDUCTION = 0.5  # share of triangles that simplification takes away above the finest level
_KEPT_SHARE = 0.99  # of the ground that simplification must leave covered
_REACH = 6.0  # grid steps about a tile's corner in which simplification may have cut it off
# Detail limits are set for photogrammetric tilesets, whose stated error is several times the step
# of their grid; a height field's is put on the same scale.
ERROR_PER_STEP = 2.0


def height_mesh(
    heights: np.ma.MaskedArray,
    shown: NDArray[np.bool_],
    step: tuple[float, float],
    *,
    lossless: bool,
) -> tuple[Array, NDArray[np.int32]] | None:
    """Vertices (V, 3), x east and y north of the tile's first vertex, and faces (F, 3); None if
    nothing is left.

    heights: (n + 1, n + 1), m, the northern row first; masked where unknown. shown: which pixels of
    the tile's image are known. step: distance of neighbouring vertices to the east and to the
    south, m. lossless: keep the surface exact (the finest level); otherwise simplification removes
    half of the triangles. Vertical strips (skirts) two steps deep hang from the tile's border, so
    that no gap shows between neighbouring tiles. Cells with an unknown corner or without image are
    left out.
    """
    n = heights.shape[0] - 1
    known = ~np.ma.getmaskarray(heights)
    whole = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    rows = np.minimum((np.arange(n) + 0.5) * shown.shape[0] / n, shown.shape[0] - 1).astype(int)
    whole &= shown[np.ix_(rows, rows)]
    if not whole.any():
        return None
    r, c = np.nonzero(whole)
    corner = r * (n + 1) + c
    below = corner + n + 1
    faces = np.concatenate(
        [np.stack([corner, below, corner + 1], 1), np.stack([corner + 1, below, below + 1], 1)]
    )
    gy, gx = np.mgrid[0 : n + 1, 0 : n + 1]
    points = np.stack([gx * step[0], -gy * step[1], np.where(known, heights.data, 0.0)], -1)
    used, index = np.unique(faces, return_inverse=True)
    points, faces = points.reshape(-1, 3)[used], index.reshape(-1, 3)
    ends = np.flatnonzero(np.isin(used, (0, n, n * (n + 1), (n + 1) ** 2 - 1)))
    corners = points[ends]
    points, faces = _simplified(points, faces, lossless)
    points, faces = _with_corners(points, faces, corners, reach=_REACH * max(step))
    extent = (n * step[0], n * step[1])
    return _skirted(points, faces.astype(np.int32), extent, depth=2 * max(step))


def _simplified(
    points: Array, faces: NDArray[np.int64], lossless: bool
) -> tuple[Array, NDArray[np.int64]]:
    base = points.mean(axis=0)
    local = points - base
    if lossless:
        out, kept = fast_simplification.simplify(local, faces, 0.5, lossless=True)
    else:
        out, kept = fast_simplification.simplify(local, faces, REDUCTION)
    # Ground that is flat to the last digit, as lakes are made, loses its rim: 40 % of a tile.
    if len(kept) == 0 or _covered(out, kept) < _KEPT_SHARE * _covered(local, faces):
        return points, faces
    return np.asarray(out, np.float64) + base, np.asarray(kept)


def _with_corners(
    points: Array, faces: NDArray[np.integer], corners: Array, reach: float
) -> tuple[Array, NDArray[np.integer]]:
    """The mesh with the tile's corners (K, 3) restored that simplification cut off.

    Simplification moves a corner's vertex along the border, in the neighbouring tiles, too. Without
    this repair the ground has a hole of one to two steps where four tiles meet. The border edges
    within `reach` metres whose outer side faces the corner are joined with it.
    """
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, count = np.unique(
        np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True
    )
    rim = sides[first[count == 1]]
    for corner in corners:
        a, b = points[rim[:, 0], :2] - corner[:2], points[rim[:, 1], :2] - corner[:2]
        away = np.stack([np.abs(a).max(axis=1), np.abs(b).max(axis=1)], 1)
        if away.min() < 1e-3 * reach:
            continue  # its vertex is still there
        outer = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0.0
        cut = rim[outer & (away.max(axis=1) < reach)]
        joined = np.stack([cut[:, 1], cut[:, 0], np.full(len(cut), len(points))], 1)
        points, faces = np.concatenate([points, corner[None]]), np.concatenate([faces, joined])
    return points, faces


def _covered(points: NDArray[np.floating], faces: NDArray[np.integer]) -> float:
    """Area of the triangles as seen from above, square metres."""
    a, b, c = (points[faces[:, k], :2] for k in range(3))
    (x1, y1), (x2, y2) = (b - a).T, (c - a).T
    return float(np.abs(x1 * y2 - x2 * y1).sum() / 2.0)


def _skirted(
    points: Array, faces: NDArray[np.int32], extent: tuple[float, float], depth: float
) -> tuple[Array, NDArray[np.int32]]:
    """The mesh with vertical strips, `depth` metres deep, below its edges on the tile's border."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    slack = 1e-3 * max(extent)
    x, y = points[edges, 0], points[edges, 1]
    on_border = (
        (np.abs(x) < slack).all(1)
        | (np.abs(x - extent[0]) < slack).all(1)
        | (np.abs(y) < slack).all(1)
        | (np.abs(y + extent[1]) < slack).all(1)
    )
    edges = edges[on_border]
    top, inverse = np.unique(edges, return_inverse=True)
    bottom = inverse.reshape(-1, 2).astype(np.int32) + np.int32(len(points))
    hung = points[top] - (0.0, 0.0, depth)
    strips = np.concatenate(
        [
            np.stack([edges[:, 1], edges[:, 0], bottom[:, 0]], 1),
            np.stack([edges[:, 1], bottom[:, 0], bottom[:, 1]], 1),
        ]
    )
    return np.concatenate([points, hung]), np.concatenate([faces, strips]).astype(np.int32)
