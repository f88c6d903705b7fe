"""Finds surface points: by the rendered depth, by the triangles, or of a ray at full detail."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from localizer.geometry.pose import Array
from localizer.map.cache.cache import REPLACE, TileCache
from localizer.map.cache.tile import TileMesh

_DETAIL_RAD = 5e-4  # a node is fine enough when its error is this small, seen from the eye
_MOST_NODES = 64  # of a ray along the horizon: what comes later is not looked for


class MapSurface:
    """Casts rays into a cache's finest tiles, of which it reads only the geometry.

    The renderer's tiles suit the image and may be off by several pixels, which is metres at a
    target. Therefore they are not used here. Safe to use from several threads; a cast may wait for
    the disk.
    """

    def __init__(self, cache: TileCache, byte_budget: int = 64 << 20) -> None:
        """byte_budget: of geometry kept in memory."""
        self._cache = cache
        self._budget = byte_budget
        self._meshes: OrderedDict[int, TileMesh] = OrderedDict()  # by tile, least recent first
        self._bytes = 0
        self._lock = threading.Lock()
        warm_up()

    def cast(self, origin: Array, directions: Array) -> BundleHits:
        """The nearest hits of rays with similar directions: origin (3,), directions (N, 3), world
        frame.

        `MapCacheError` for a tile that cannot be read.
        """
        distances = np.full(len(directions), np.nan)
        normals = np.zeros((len(directions), 3))
        length = float(np.linalg.norm(directions, axis=1).min())
        for node, nearest in self._nodes(origin, directions):
            if not (distances * length >= nearest).any() and np.isfinite(distances).all():
                break
            hits = cast_bundle(self._load(node), origin, directions)
            nearer = ~(hits.distances >= distances) & np.isfinite(hits.distances)
            distances[nearer], normals[nearer] = hits.distances[nearer], hits.normals[nearer]
        return BundleHits(distances, normals)

    @property
    def resident_bytes(self) -> int:
        """Bytes of the geometry in memory."""
        with self._lock:
            return sum(mesh.nbytes for mesh in self._meshes.values())

    def _nodes(self, origin: Array, directions: Array) -> Iterator[tuple[int, float]]:
        """Nodes that the bundle may meet, with the distance (m) of their boxes, nearest first."""
        index = self._cache.index
        pyramid = Pyramid.about(directions)
        found: list[NDArray[np.int64]] = []
        level = np.zeros(1, np.int64)
        while len(level):
            low, high = index.box_min[level], index.box_max[level]
            level = level[pyramid.meets_boxes(low - origin, high - origin)]
            fine = index.geometric_error[level] <= _DETAIL_RAD * self._distance(origin, level)
            drawn = index.tile_count[level] > 0
            ends = (index.child_count[level] == 0) | (fine & drawn)
            found.append(level[drawn & (ends | (index.refine[level] != REPLACE))])
            inner = level[~ends]
            children = [
                np.arange(s, s + n)
                for s, n in zip(index.child_start[inner], index.child_count[inner], strict=True)
            ]
            level = np.concatenate([np.empty(0, np.int64), *children])
        nodes = np.concatenate(found)
        distances = self._distance(origin, nodes)
        for i in np.argsort(distances, kind="stable")[:_MOST_NODES]:
            yield int(nodes[i]), float(distances[i])

    def _distance(self, origin: Array, nodes: NDArray[np.int64]) -> Array:
        """Metres from a point to the nodes' boxes: (N,), 0 inside."""
        low, high = self._cache.index.box_min[nodes], self._cache.index.box_max[nodes]
        gap = np.maximum(np.maximum(low - origin, origin - high), 0.0)
        return np.asarray(np.linalg.norm(gap, axis=1))

    def _load(self, node: int) -> list[TileMesh]:
        with self._lock:
            return [self._tile(t) for t in self._cache.index.tiles_of(node)]

    def _tile(self, tile: int) -> TileMesh:
        """A tile's mesh from memory or disk. The caller holds the lock."""
        mesh = self._meshes.pop(tile, None)
        if mesh is None:
            mesh = self._cache.load_geometry(tile)
            self._bytes += mesh.nbytes
        self._meshes[tile] = mesh
        while self._bytes > self._budget and len(self._meshes) > 1:
            _, oldest = self._meshes.popitem(last=False)
            self._bytes -= oldest.nbytes
        return mesh


# Between tiles, whose corners are rounded each to its own float32, nothing is open: metres, and the
# same as a share of a triangle's side, by which it is widened for rays that meet nothing else.
_SEAM_M, _SEAM = 1e-3, 1e-4
_CORNERS = np.array(list(np.ndindex(2, 2, 2)), np.bool_)


@dataclass(frozen=True)
class BundleHits:
    """Hits of a ray bundle on the map. distances: (N,) in multiples of the directions, NaN without
    a hit; normals: (N, 3) unit, world axes, towards the origin.
    """

    distances: Array
    normals: Array


@dataclass(frozen=True)
class Pyramid:
    """Four planes through the origin that enclose a ray bundle. axes: (3, 3) rows x, y, and z times
    the slope; inside, |x| and |y| are at most z.
    """

    axes: Array

    @classmethod
    def about(cls, directions: Array) -> Pyramid:
        """The pyramid about a bundle of directions (N, 3), all within 90 degrees of their mean."""
        axis = directions.mean(axis=0)
        axis = axis / np.linalg.norm(axis)
        sideways = np.linalg.svd(axis[None, :])[2][1:]
        slopes = np.abs(directions @ sideways.T) / (directions @ axis)[:, None]
        return cls(np.vstack([sideways, axis * (float(slopes.max()) * (1 + 1e-9) + 1e-9)]))

    def beyond(self, points: Array) -> NDArray[np.uint8]:
        """For each point (..., 3), a bit for each of the four planes that it is outside of."""
        x, y, z = np.moveaxis(points @ self.axes.T, -1, 0)
        z = z + _SEAM_M
        return np.asarray((x > z) + 2 * (-x > z) + 4 * (y > z) + 8 * (-y > z), np.uint8)

    def meets_boxes(self, low: Array, high: Array) -> NDArray[np.bool_]:
        """Whether each box (N,) with corners (N, 3) is not entirely outside one plane."""
        corners = np.where(_CORNERS[None, :, :], high[:, None, :], low[:, None, :])
        meets: NDArray[np.bool_] = np.bitwise_and.reduce(self.beyond(corners), axis=1) == 0
        return meets


def cast_rays(meshes: Sequence[TileMesh], origin: ArrayLike, directions: ArrayLike) -> Array:
    """Distances (N,), in multiples of `directions` (N, 3), at which rays from `origin` (3,) first
    hit a triangle.

    World frame; NaN where a ray meets nothing. Both sides of a triangle count.
    """
    directions = np.asarray(directions, dtype=np.float64).reshape(-1, 3)
    nearest = _nearest(meshes, origin, directions, 0.0)
    missed = ~np.isfinite(nearest)
    if missed.any():
        nearest[missed] = _nearest(meshes, origin, directions[missed], _SEAM)
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _nearest(
    meshes: Sequence[TileMesh], origin: ArrayLike, directions: Array, seam: float
) -> Array:
    nearest = np.full(len(directions), np.inf)
    for mesh in meshes:
        tile_from_world = mesh.world_from_tile.inverse
        local = np.ascontiguousarray(directions @ tile_from_world.rotation.T)
        box, eye = mesh.bounds, tile_from_world.apply(origin)
        _cast(mesh.positions, mesh.faces, box, eye, local, seam, nearest)
    return nearest


def cast_bundle(meshes: Sequence[TileMesh], origin: Array, directions: Array) -> BundleHits:
    """The nearest hits of rays from `origin` (3,) with similar directions (N, 3).

    It takes about as long as one ray of `cast_rays`: a triangle outside one of the bundle's four
    bounding planes is skipped for all rays.
    """
    nearest, normals = _nearest_of_bundle(meshes, origin, directions, 0.0)
    missed = ~np.isfinite(nearest)
    if missed.any():
        found = _nearest_of_bundle(meshes, origin, directions[missed], _SEAM)
        nearest[missed], normals[missed] = found
    return BundleHits(np.where(np.isfinite(nearest), nearest, np.nan), normals)


def _nearest_of_bundle(
    meshes: Sequence[TileMesh], origin: Array, directions: Array, seam: float
) -> tuple[Array, Array]:
    pyramid = Pyramid.about(directions)
    nearest = np.full(len(directions), np.inf)
    normals = np.zeros((len(directions), 3))
    for mesh in meshes:
        tile_from_world = mesh.world_from_tile.inverse
        turn = tile_from_world.rotation.T
        eye, local = tile_from_world.apply(origin), np.ascontiguousarray(directions @ turn)
        low, high = mesh.bounds
        turned = Pyramid(pyramid.axes @ turn)
        if not turned.meets_boxes((low - eye)[None, :], (high - eye)[None, :])[0]:
            continue
        beyond = turned.beyond(mesh.positions - eye)
        hit = np.full(len(directions), -1, np.int32)
        _cast_bundle(mesh.positions, mesh.faces, beyond, eye, local, seam, nearest, hit)
        new = hit >= 0
        normals[new] = _normals(mesh, hit[new], local[new]) @ turn.T
    return nearest, normals


def warm_up() -> None:
    """Compile the ray-casting kernels before the first target in flight."""
    corner = np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 1]], np.float32)
    faces, beyond = np.array([[0, 1, 2]], np.int32), np.zeros(3, np.uint8)
    hit, nearest = np.zeros(1, np.int32), np.full(1, np.inf)
    _cast_bundle(corner, faces, beyond, np.zeros(3), np.ones((1, 3)), 0.0, nearest, hit)


def _normals(mesh: TileMesh, faces: NDArray[np.int32], directions: Array) -> Array:
    """Unit normals (N, 3) of faces in the tile's axes, turned against the directions (N, 3)."""
    p, q, s = np.moveaxis(mesh.positions[mesh.faces[faces]].astype(np.float64), 1, 0)
    n = np.cross(q - p, s - p)
    n /= np.linalg.norm(n, axis=1)[:, None]
    return np.where(((n * directions).sum(axis=1) > 0)[:, None], -n, n)


@njit(cache=True, nogil=True)
def _cast(positions, faces, box, origin, directions, seam, nearest):  # type: ignore[no-untyped-def]
    """Intersect every ray that meets the box with every triangle; updates `nearest`."""
    low, high = box
    for r in range(directions.shape[0]):
        d = directions[r]
        enter, leave = 0.0, nearest[r]
        for a in range(3):
            below, above = low[a] - _SEAM_M - origin[a], high[a] + _SEAM_M - origin[a]
            if d[a] == 0.0:
                if below > 0.0 or above < 0.0:
                    leave = -1.0
                continue
            t0, t1 = below / d[a], above / d[a]
            enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
        if enter > leave + 1e-6 * abs(leave):
            continue
        for f in range(faces.shape[0]):
            t = _meet(positions, faces[f], origin, d, seam)
            if 0.0 < t < nearest[r]:
                nearest[r] = t


@njit(cache=True, nogil=True)
def _cast_bundle(  # type: ignore[no-untyped-def]
    positions, faces, beyond, origin, directions, seam, nearest, hit
):
    """As `_cast` for a bundle, with the face that each ray hits; `beyond`: of the vertices."""
    for f in range(faces.shape[0]):
        if beyond[faces[f, 0]] & beyond[faces[f, 1]] & beyond[faces[f, 2]]:
            continue
        for r in range(directions.shape[0]):
            t = _meet(positions, faces[f], origin, directions[r], seam)
            if 0.0 < t < nearest[r]:
                nearest[r] = t
                hit[r] = f


@njit(cache=True, nogil=True)
def _meet(positions, face, origin, d, seam):  # type: ignore[no-untyped-def]
    """Where a ray meets a triangle (Möller and Trumbore), in multiples of `d`; -1 if nowhere.

    seam: share of its sides by which it is widened.
    """
    p, q, s = positions[face[0]], positions[face[1]], positions[face[2]]
    ax, ay, az = float(p[0]), float(p[1]), float(p[2])
    ux, uy, uz = q[0] - ax, q[1] - ay, q[2] - az
    vx, vy, vz = s[0] - ax, s[1] - ay, s[2] - az
    hx, hy, hz = d[1] * vz - d[2] * vy, d[2] * vx - d[0] * vz, d[0] * vy - d[1] * vx
    det = ux * hx + uy * hy + uz * hz
    if det == 0.0:
        return -1.0
    inv = 1.0 / det
    ox, oy, oz = origin[0] - ax, origin[1] - ay, origin[2] - az
    b = (ox * hx + oy * hy + oz * hz) * inv
    if b < -seam or b > 1.0 + seam:
        return -1.0
    gx, gy, gz = oy * uz - oz * uy, oz * ux - ox * uz, ox * uy - oy * ux
    c = (d[0] * gx + d[1] * gy + d[2] * gz) * inv
    if c < -seam or b + c > 1.0 + seam:
        return -1.0
    return (vx * gx + vy * gy + vz * gz) * inv
