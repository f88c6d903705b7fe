"""From a pixel to the map's surface: by the rendered depth, or exactly by its triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from localizer.map.tile import TileMesh
from localizer.pose import Array
from localizer.types import RenderedView

_JUMP = 0.02  # relative change of depth between neighbouring pixels that may be an edge


def pick(
    view: RenderedView, pixels: ArrayLike, meshes: Sequence[TileMesh] = ()
) -> tuple[Array, NDArray[np.bool_]]:
    """Surface points (N, 3) in world metres under pixels (N, 2), and which of them exist.

    1/z is linear in the image on a plane, so it is interpolated bilinearly. Where neighbouring
    depths jump (a roof's edge, the skyline) that would invent points in mid-air: there the nearest
    pixel's depth is taken. With `meshes` (what the view was drawn from) every ray is intersected
    with their triangles instead, exactly; about 0.3 ms a pixel.
    """
    pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    rays = view.camera.rays(pixels)
    if len(meshes):
        directions = rays @ view.world_from_camera.rotation.T
        z = cast_rays(meshes, view.world_from_camera.translation, directions)
    else:
        z = _interpolated_depth(view.depth, pixels)
    valid = np.isfinite(z) & (z > 0)
    points = view.world_from_camera.apply(rays * np.where(valid, z, np.nan)[:, None])
    return points, valid


def cast_rays(meshes: Sequence[TileMesh], origin: ArrayLike, directions: ArrayLike) -> Array:
    """Multiples (N,) of `directions` (N, 3) at which rays from `origin` (3,) first meet a triangle.

    World frame; NaN where a ray meets nothing. Both sides of a triangle count.
    """
    directions = np.asarray(directions, dtype=np.float64).reshape(-1, 3)
    nearest = np.full(len(directions), np.inf)
    for mesh in meshes:
        tile_from_world = mesh.world_from_tile.inverse
        local = np.ascontiguousarray(directions @ tile_from_world.rotation.T)
        low, high = mesh.bounds
        _cast(mesh.positions, mesh.faces, low, high, tile_from_world.apply(origin), local, nearest)
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _interpolated_depth(depth: NDArray[np.float32], pixels: Array) -> Array:
    """Depth (N,) at sub-pixel positions, 0 outside the image and where there is none."""
    h, w = depth.shape
    inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] <= w) & (pixels[:, 1] <= h)
    x = np.clip(np.nan_to_num(pixels[:, 0]) - 0.5, 0, w - 1)
    y = np.clip(np.nan_to_num(pixels[:, 1]) - 0.5, 0, h - 1)
    x0, y0 = np.minimum(x.astype(int), w - 2), np.minimum(y.astype(int), h - 2)
    fx, fy = x - x0, y - y0
    corners = np.stack(
        [depth[y0, x0], depth[y0, x0 + 1], depth[y0 + 1, x0], depth[y0 + 1, x0 + 1]]
    ).astype(np.float64)
    low, high = corners.min(axis=0), corners.max(axis=0)
    smooth = (low > 0) & (high <= low * (1 + _JUMP))
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    with np.errstate(divide="ignore", invalid="ignore"):
        interpolated = 1 / (weights / corners).sum(axis=0)
    nearest = depth[np.rint(y).astype(int), np.rint(x).astype(int)]
    return np.where(inside, np.where(smooth, interpolated, nearest), 0.0)


@njit(cache=True, nogil=True)
def _cast(positions, faces, low, high, origin, directions, nearest):  # type: ignore[no-untyped-def]
    """Möller and Trumbore's intersection of every ray that meets the box with every triangle."""
    for r in range(directions.shape[0]):
        d = directions[r]
        enter, leave = 0.0, nearest[r]
        for a in range(3):
            if d[a] == 0.0:
                if origin[a] < low[a] or origin[a] > high[a]:
                    leave = -1.0
                continue
            t0, t1 = (low[a] - origin[a]) / d[a], (high[a] - origin[a]) / d[a]
            enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
        if enter > leave + 1e-6 * abs(leave):
            continue
        for f in range(faces.shape[0]):
            p, q, s = positions[faces[f, 0]], positions[faces[f, 1]], positions[faces[f, 2]]
            ax, ay, az = float(p[0]), float(p[1]), float(p[2])
            ux, uy, uz = q[0] - ax, q[1] - ay, q[2] - az
            vx, vy, vz = s[0] - ax, s[1] - ay, s[2] - az
            hx, hy, hz = d[1] * vz - d[2] * vy, d[2] * vx - d[0] * vz, d[0] * vy - d[1] * vx
            det = ux * hx + uy * hy + uz * hz
            if det == 0.0:
                continue
            inv = 1.0 / det
            ox, oy, oz = origin[0] - ax, origin[1] - ay, origin[2] - az
            b = (ox * hx + oy * hy + oz * hz) * inv
            if b < 0.0 or b > 1.0:
                continue
            gx, gy, gz = oy * uz - oz * uy, oz * ux - ox * uz, ox * uy - oy * ux
            c = (d[0] * gx + d[1] * gy + d[2] * gz) * inv
            if c < 0.0 or b + c > 1.0:
                continue
            t = (vx * gx + vy * gy + vz * gz) * inv
            if 0.0 < t < nearest[r]:
                nearest[r] = t
