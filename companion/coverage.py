"""Is there a map under the mission? Its places and the straight ways between them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from localizer.geo import LocalFrame
from localizer.map.cache import TileCache
from localizer.pose import Array
from mavlink_bridge.doctor import Finding
from mavlink_bridge.mission import Waypoint

_STEP_M = 25.0
_NAME = "mission"
_NEEDED = "inside the map"


def covered(cache: TileCache, points: Array) -> np.ndarray:
    """Which points (N, 2), ENU metres, have a finest tile under them: (N,) bool."""
    index = cache.index
    leaves = (index.child_count == 0) & (index.tile_count > 0)
    low, high = index.box_min[leaves, :2], index.box_max[leaves, :2]
    inside = np.zeros(len(points), bool)
    for i, point in enumerate(points):
        inside[i] = bool(((low <= point) & (point <= high)).all(axis=1).any())
    return inside


def _enu(frame: LocalFrame, waypoints: Sequence[Waypoint]) -> Array:
    """(N, 2) metres about the map's origin."""
    height = frame.origin.height_m
    places = [frame.enu_from_geodetic(w.latitude_deg, w.longitude_deg, height) for w in waypoints]
    return np.array(places).reshape(-1, 3)[:, :2]


def _way(points: Array) -> Array:
    """Points (N, 2) every 25 m along the straight legs between the given ones."""
    parts = [points[:1]]
    for start, end in itertools.pairwise(points):
        steps = max(int(np.ceil(np.linalg.norm(end - start) / _STEP_M)), 1)
        parts.append(start + (end - start) * np.arange(1, steps + 1)[:, None] / steps)
    return np.concatenate(parts)


def check_mission(cache: TileCache, waypoints: Sequence[Waypoint]) -> Finding:
    """Advice where the mission leaves the map: vision ends there."""
    if not [w for w in waypoints if w.number > 0]:
        return Finding(_NAME, "none in the vehicle", _NEEDED, "nothing to check", True, False)
    points = _enu(cache.frame, waypoints)
    outside = [w.number for w, inside in zip(waypoints, covered(cache, points), strict=True)
               if not inside]  # fmt: skip
    way = covered(cache, _way(points))
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    found = f"{len(waypoints)} places, {length / 1000:.1f} km"
    if way.all() and not outside:
        return Finding(
            _NAME, found, _NEEDED, "place and way, not what the camera sees", True, False
        )
    share = 100.0 * float(1.0 - way.mean())
    where = f"; items {_listed(outside)} outside" if outside else "; no item outside"
    why = f"no position by vision on {share:.0f} % of the way: build a larger map or move it"
    return Finding(_NAME, found + where, _NEEDED, why, False, False)


def _listed(numbers: Sequence[int]) -> str:
    """A list that fits the table."""
    shown = ", ".join(str(n) for n in numbers[:8])
    return shown if len(numbers) <= 8 else f"{shown} and {len(numbers) - 8} more"
