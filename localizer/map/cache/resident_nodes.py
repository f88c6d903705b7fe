"""Nodes in memory; the least recently used are evicted first."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from localizer.map.cache.tile import TileMesh


class ResidentNodes:
    """Nodes in memory. Callers hold the streamer's lock.

    sizes: bytes of each node (N,), whether in memory or not; resident: (N,), whether it is in
    memory; bytes: sum of the nodes in memory. evicted: removed nodes that are not yet freed;
    evictions: number of removals so far.
    """

    def __init__(self, sizes: NDArray[np.int64], budget: int) -> None:
        self.sizes, self.budget = sizes, budget
        self.resident = np.zeros(len(sizes), np.bool_)
        self.bytes = self.evictions = 0
        self.evicted: list[list[TileMesh]] = []
        self._meshes: OrderedDict[int, list[TileMesh]] = OrderedDict()  # least recent first

    def use(self, node: int) -> Sequence[TileMesh]:
        """A resident node's meshes; marks the node as the most recently used."""
        self._meshes.move_to_end(node)
        return self._meshes[node]

    def add(self, node: int, meshes: list[TileMesh], *, keep: Collection[int], beside: int) -> None:
        """Add a node and evict others if necessary, but not those in `keep`, so that a view can
        complete; the budget may then be exceeded. beside: further bytes in memory that count
        against the budget.
        """
        size = int(self.sizes[node])
        self._make_room(beside + size, keep)
        self._meshes[node] = meshes
        self.resident[node] = True
        self.bytes += size

    def take_evicted(self) -> list[list[TileMesh]]:
        """The evicted nodes, to be freed where it delays nothing."""
        taken, self.evicted = self.evicted, []
        return taken

    def clear(self) -> None:
        """Drop all tiles."""
        self._meshes.clear()
        self.evicted.clear()
        self.resident[:] = False
        self.bytes = 0

    def _make_room(self, needed: int, keep: Collection[int]) -> None:
        for node in list(self._meshes):
            if self.bytes + needed <= self.budget:
                return
            if node in keep:
                continue
            self.evicted.append(self._meshes.pop(node))
            self.resident[node] = False
            self.bytes -= int(self.sizes[node])
            self.evictions += 1
