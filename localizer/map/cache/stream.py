"""Streams tiles: a view's tiles come from memory, missing ones are loaded in the background.

`select` does not wait for the disk unless told to. Resident parents replace missing detail. One
thread loads tiles (decoding releases the GIL); least recently used nodes are evicted when the byte
budget is full. `TileStreamer.lacks_tiles`: whether the latest selection lacked tiles that were to
be read; they may be in memory by now.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.errors import MapCacheError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache, read_manifest
from localizer.map.cache.hold import CacheLock
from localizer.map.cache.select import DetailLimits, Selection, TileSelector
from localizer.map.cache.tile import TileMesh

_log = logging.getLogger(__name__)
_CLOSE_S = 10.0  # for a tile to be read to its end
# Limit of the new data of one selection, so that the upload does not slow the renderer; there is no
# limit for a selection that waits.
_BYTES_PER_SELECT = 64 << 20


@dataclass(frozen=True)
class StreamCounters:
    """Counters since the streamer was made.

    hits, misses: needed nodes that were in memory, or were not; complete: selections with the
    needed detail everywhere; stalls: selections with a hole; failures: failed attempts to read a
    node; unreadable: nodes whose last attempt failed; loaded, evicted: numbers of nodes;
    resident_bytes: memory in use now.
    """

    selections: int = 0
    complete: int = 0
    stalls: int = 0
    hits: int = 0
    misses: int = 0
    loaded: int = 0
    evicted: int = 0
    failures: int = 0
    unreadable: int = 0
    resident_bytes: int = 0


class TileStreamer:
    """Streams tiles of a cache within a byte budget; one thread selects and prefetches."""

    def __init__(
        self,
        cache: TileCache,
        byte_budget: int = 512 << 20,
        max_error_px: float = DetailLimits.max_error_px,
        max_texel_px: float = DetailLimits.max_texel_px,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start the loader thread and lock the cache, so that no build replaces it until `close`.
        MapCacheError if one has replaced it since it was opened.

        byte_budget: size limit of the decoded tiles. max_error_px, max_texel_px: see
        `DetailLimits`. clock: in seconds; nodes that could not be read are tried again by it.
        """
        self.cache = cache
        self._selector = TileSelector(cache.index, cache.frame)
        self._limits = DetailLimits(max_error_px, max_texel_px)
        self._nodes = ResidentNodes(_node_bytes(cache), byte_budget)
        self._failed = FailedNodes(clock)
        self._current: list[TileMesh] = []
        self._counts = dict.fromkeys(StreamCounters.__dataclass_fields__, 0)
        self._lock = threading.Condition()
        self._queue: list[int] = []  # nodes to load, most urgent first
        self._ahead: list[int] = []  # after those
        self._arrived: list[tuple[int, list[TileMesh]]] = []  # loaded, not yet in use
        self._arrived_bytes = 0
        self._protected: set[int] = set()  # in the current view
        self._closed = self._waiting = self.lacks_tiles = False
        self._hold = _held(cache)
        self._thread = threading.Thread(target=self._run, name="tile-loader", daemon=True)
        self._thread.start()

    def select(
        self, world_from_camera: Pose, camera: Camera, *, wait: bool = False
    ) -> list[TileMesh]:
        """Meshes to draw for a view; missing tiles are loaded in the background.

        wait: block until all needed detail is resident. A tile that cannot be read then raises
        `MapCacheError`. Without `wait` its parent is shown, and the failure is logged.
        """
        limits = self._fitting_limits(world_from_camera, camera)
        with self._lock:
            self._take_in(None if wait else _BYTES_PER_SELECT)
            choice = self._choose(world_from_camera, camera, limits)
            while wait and not self._nodes.resident[choice.wanted].all():
                missing = choice.wanted[~self._nodes.resident[choice.wanted]].tolist()
                for node in missing:
                    self._failed.check(node)
                self._queue = missing
                self._lock.notify_all()
                self._lock.wait()
                self._take_in(None)
                choice = self._choose(world_from_camera, camera, limits)
            self._count(choice)
            shown = (self._nodes.use(node) for node in choice.shown.tolist())
            self._current = [mesh for meshes in shown for mesh in meshes]
            return list(self._current)

    def current(self) -> list[TileMesh]:
        """The meshes of the latest `select`; may be called from any thread (for picking)."""
        with self._lock:
            return list(self._current)

    def prefetch(self, views: Sequence[Pose], camera: Camera) -> None:
        """Have the tiles of future views (world_from_camera) loaded in order, after the current
        view's, as far as the budget allows; returns at once.
        """
        limits = [self._fitting_limits(view, camera) for view in views]
        with self._lock:
            room = self._nodes.budget - int(self._nodes.sizes[list(self._protected)].sum())
            seen = set(self._protected)
            self._ahead = []
            for view, limit in zip(views, limits, strict=True):
                choice = self._selector.select(view, camera, self._nodes.resident, limit)
                for node in choice.wanted.tolist():
                    if node in seen:
                        continue
                    seen.add(node)
                    room -= int(self._nodes.sizes[node])
                    if room < 0:
                        break
                    if self._nodes.resident[node]:
                        self._nodes.use(node)
                    elif not self._failed.is_waiting(node):
                        self._ahead.append(node)
            self._lock.notify_all()

    def counters(self) -> StreamCounters:
        """Counters since the streamer was made."""
        with self._lock:
            now = {
                "resident_bytes": self._nodes.bytes + self._arrived_bytes,
                "evicted": self._nodes.evictions,
                "failures": self._failed.attempts,
                "unreadable": len(self._failed),
            }
            return StreamCounters(**self._counts | now)

    @property
    def idle(self) -> bool:
        """Whether the loader has nothing to do."""
        with self._lock:
            return self._waiting and not (self._nodes.evicted or self._to_load())

    def close(self) -> None:
        """Stop the loader thread (waits at most 10 s), drop all tiles, and unlock the cache."""
        with self._lock:
            self._closed = True
            self._lock.notify_all()
        self._thread.join(_CLOSE_S)
        with self._lock:
            self._arrived.clear()
            self._nodes.clear()
        self._hold.close()

    def __enter__(self) -> TileStreamer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _fitting_limits(self, world_from_camera: Pose, camera: Camera) -> DetailLimits:
        nodes = self._nodes
        return self._selector.fitting_limits(
            world_from_camera, camera, self._limits, nodes.sizes, nodes.budget
        )

    def _choose(self, world_from_camera: Pose, camera: Camera, limits: DetailLimits) -> Selection:
        """Select nodes and give the loader its list. Needs the lock."""
        if self._closed:
            raise RuntimeError("the tile streamer is closed")
        choice = self._selector.select(world_from_camera, camera, self._nodes.resident, limits)
        self._protected = {0, *choice.wanted.tolist(), *choice.shown.tolist()}
        self._queue = [n for n in choice.requests.tolist() if not self._failed.is_waiting(n)]
        self.lacks_tiles = bool(self._queue)
        self._lock.notify_all()
        return choice

    def _count(self, choice: Selection) -> None:
        hits = int(self._nodes.resident[choice.wanted].sum())
        self._counts["selections"] += 1
        self._counts["hits"] += hits
        self._counts["misses"] += len(choice.wanted) - hits
        self._counts["complete"] += hits == len(choice.wanted)
        self._counts["stalls"] += choice.hole

    def _run(self) -> None:
        while True:
            with self._lock:
                while not (self._closed or self._nodes.evicted or self._to_load()):
                    self._waiting = True
                    self._lock.wait()
                    self._waiting = False
                if self._closed:
                    return
                evicted = self._nodes.take_evicted()
            # Giving megabytes back to the system takes its time: not the render thread's.
            del evicted
            with self._lock:
                nodes = self._to_load()
                if not nodes:
                    continue
                node = nodes.pop(0)
                # A node may have been asked for again while it was being loaded.
                has_arrived = any(node == arrived for arrived, _ in self._arrived)
                if has_arrived or self._failed.is_waiting(node) or self._nodes.resident[node]:
                    continue
            loaded = _load(self.cache, node)
            with self._lock:
                if isinstance(loaded, MapCacheError):
                    self._failed.add(node, loaded)
                else:
                    self._arrived.append((node, loaded))
                    self._arrived_bytes += int(self._nodes.sizes[node])
                    self._counts["loaded"] += 1
                    self._failed.remove(node)
                self._lock.notify_all()

    def _to_load(self) -> list[int]:
        """Nodes to load, in order; empty while there is no room for them."""
        if self._arrived_bytes >= _BYTES_PER_SELECT:
            return []
        return self._queue or self._ahead

    def _take_in(self, limit: int | None) -> None:
        """Make loaded nodes resident, at most `limit` bytes but at least one. Needs the lock."""
        taken = 0
        while self._arrived and (limit is None or taken < limit):
            node, meshes = self._arrived.pop(0)
            size = int(self._nodes.sizes[node])
            self._arrived_bytes -= size
            taken += size
            self._nodes.add(node, meshes, keep=self._protected, beside=self._arrived_bytes)


def _held(cache: TileCache) -> CacheLock:
    hold = CacheLock(cache.path)
    try:
        if read_manifest(cache.path).index_sha256 != cache.manifest.index_sha256:
            raise MapCacheError(f"{cache.path}: was built again since it was opened")
    except BaseException:
        hold.close()
        raise
    return hold


def _load(cache: TileCache, node: int) -> list[TileMesh] | MapCacheError:
    try:
        return [_ready(cache.load_tile(t)) for t in cache.index.tiles_of(node)]
    except MapCacheError as error:
        return error
    except Exception as error:  # or nothing would be loaded ever again
        _log.debug("unexpected, while loading the map", exc_info=True)
        return MapCacheError(f"node {node} of the map: {type(error).__name__}: {error}")


def _ready(mesh: TileMesh) -> TileMesh:
    """The mesh with the values for drawing computed here, not on the render thread."""
    _ = mesh.bounds, mesh.texture
    return mesh


def _node_bytes(cache: TileCache) -> NDArray[np.int64]:
    index = cache.index
    total = np.concatenate([[0], np.cumsum(index.size)])
    return np.asarray(total[index.tile_start + index.tile_count] - total[index.tile_start])


_RETRY_S, _RETRY_MOST_S = 0.5, 30.0  # between attempts at a node that could not be read


@dataclass(frozen=True)
class _Failure:
    """Why a node could not be read, how often in a row, and when it is tried again."""

    error: MapCacheError
    count: int
    again_s: float


class FailedNodes:
    """Nodes that could not be read. Callers hold the streamer's lock. clock: returns seconds.
    attempts: number of failures so far.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._failures: dict[int, _Failure] = {}
        self.attempts = 0

    def __len__(self) -> int:
        return len(self._failures)

    def add(self, node: int, error: MapCacheError) -> None:
        """Record a failed read, and log a node's first; each further one delays its retry
        longer.
        """
        before = self._failures.get(node)
        if before is None:
            _log.error("%s", error)
        count = 1 if before is None else before.count + 1
        wait_s = min(_RETRY_S * 2.0 ** min(count - 1, 10), _RETRY_MOST_S)
        self._failures[node] = _Failure(error, count, self._clock() + wait_s)
        self.attempts += 1

    def remove(self, node: int) -> None:
        """Forget a node's failures, because it was read."""
        self._failures.pop(node, None)

    def is_waiting(self, node: int) -> bool:
        """Whether a node has failed and its retry is not due."""
        failure = self._failures.get(node)
        return failure is not None and self._clock() < failure.again_s

    def check(self, node: int) -> None:
        """Raise the node's `MapCacheError` while it is waiting."""
        if self.is_waiting(node):
            raise self._failures[node].error


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
