"""Casts single rays on the map's surface at full detail."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.map.cache.cache import REPLACE, TileCache
from localizer.map.cache.pick import BundleHits, Pyramid, cast_bundle, warm_up
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
