"""Checks map coverage of mission, position and EKF's origin, and the map's heights against GNSS."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from localizer.errors import MapCacheError
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import MapSurface
from mavlink_bridge.config import OriginConfig
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.preflight.rules import DoctorFinding
from mavlink_bridge.vehicle.mission import MissionWaypoint

_GEOID_ADVICE_M, _GEOID_LIMIT_M = 3.0, 10.0  # receivers hold coarse grids of the geoid
_GROUND_ADVICE_M = 10.0  # height by GNSS is good to a few metres, take-off ground to one
_ABOVE_M = 100.0  # the highest roof or tree that a ray from above should meet


def check_heights(cache: TileCache, state: VehicleState) -> list[DoctorFinding]:
    """Findings, good or not, on the geoid separation, if the receiver reports both heights, and on
    the ground height below the vehicle, if it is disarmed on the map; [] without a GNSS fix.
    """
    if state.gps_fix_type < _FIX_3D:
        return []
    findings = []
    altitude_m, height_m = state.gps_altitude_amsl_m, state.gps_height_m
    if altitude_m is not None and height_m is not None:
        findings.append(_geoid(cache, height_m - altitude_m))
    latitude_deg, longitude_deg = state.gps_latitude_deg, state.gps_longitude_deg
    if altitude_m is None or latitude_deg is None or longitude_deg is None or state.armed:
        return findings
    ground_m = _ground(cache, latitude_deg, longitude_deg)
    if ground_m is not None:
        findings.append(_take_off(ground_m, altitude_m))
    return findings


def _geoid(cache: TileCache, receiver_m: float) -> DoctorFinding:
    mapped = cache.manifest.geoid_separation_m
    difference = abs(receiver_m - mapped)
    return DoctorFinding(
        "geoid",
        f"{mapped:.1f} m in the map, {receiver_m:.1f} m by GNSS",
        f"within {_GEOID_ADVICE_M:.0f} m",
        "AMSL altitudes are off by the difference: build the map with the place's separation",
        difference <= _GEOID_ADVICE_M,
        difference > _GEOID_LIMIT_M,
    )


def _ground(cache: TileCache, latitude_deg: float, longitude_deg: float) -> float | None:
    """AMSL height of the map's surface at a position, metres; None outside the map."""
    top = cache.manifest.height_range_m[1] + _ABOVE_M
    place = latitude_deg, longitude_deg
    above = np.asarray(cache.frame.enu_from_geodetic(*place, top))
    below = np.asarray(cache.frame.enu_from_geodetic(*place, top - 1.0))
    try:
        depth = float(MapSurface(cache).cast(above, (below - above)[None]).distances[0])
    except MapCacheError:
        return None  # told by `map verify`
    if not math.isfinite(depth):
        return None
    return top - depth - cache.manifest.geoid_separation_m


def _take_off(ground_m: float, vehicle_m: float) -> DoctorFinding:
    off = vehicle_m - ground_m
    return DoctorFinding(
        "take-off height",
        f"{vehicle_m:.0f} m AMSL by GNSS, {ground_m:.0f} m in the map",
        f"within {_GROUND_ADVICE_M:.0f} m",
        "wrong datum or geoid separation of the map, a roof or tree above, or a poor fix",
        abs(off) <= _GROUND_ADVICE_M,
        False,
    )


_STEP_M = 25.0
_NAME = "mission"
_ORIGIN_KM = 50.0  # a take-off far from the map is odd, another country is a typing error
_ORIGIN_HEIGHT_M = 300.0
_STAND_KM = 0.3  # a take-off beside the map's edge
_BELOW_M = 1000.0  # the Earth falls away by so much within 110 km
_FIX_3D = 3
_NEEDED = "inside the map"


def is_covered(cache: TileCache, points: Array) -> np.ndarray:
    """Whether a finest tile covers each point (N, 2), ENU metres: (N,) bool."""
    index = cache.index
    leaves = (index.child_count == 0) & (index.tile_count > 0)
    low, high = index.box_min[leaves, :2], index.box_max[leaves, :2]
    inside = np.zeros(len(points), bool)
    for i, point in enumerate(points):
        inside[i] = bool(((low <= point) & (point <= high)).all(axis=1).any())
    return inside


def _enu(frame: LocalFrame, waypoints: Sequence[MissionWaypoint]) -> Array:
    """(N, 2) east and north of the map's origin, m."""
    height = frame.origin.height_m
    places = [frame.enu_from_geodetic(w.latitude_deg, w.longitude_deg, height) for w in waypoints]
    return np.array(places).reshape(-1, 3)[:, :2]


def _path_points(points: Array) -> Array:
    """Points (N, 2) every 25 m along the straight legs between the given ones."""
    parts = [points[:1]]
    for start, end in itertools.pairwise(points):
        steps = max(int(np.ceil(np.linalg.norm(end - start) / _STEP_M)), 1)
        parts.append(start + (end - start) * np.arange(1, steps + 1)[:, None] / steps)
    return np.concatenate(parts)


def check_mission(cache: TileCache, waypoints: Sequence[MissionWaypoint]) -> DoctorFinding:
    """A finding on the mission: advice if its places or straight ways leave the map, where vision
    ends; good if they do not, or if it is empty.
    """
    if not [w for w in waypoints if w.number > 0]:
        return DoctorFinding(_NAME, "none in the vehicle", _NEEDED, "nothing to check", True, False)
    points = _enu(cache.frame, waypoints)
    outside = [w.number for w, inside in zip(waypoints, is_covered(cache, points), strict=True)
               if not inside]  # fmt: skip
    way = is_covered(cache, _path_points(points))
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    found = f"{len(waypoints)} places, {length / 1000:.1f} km"
    if way.all() and not outside:
        return DoctorFinding(
            _NAME, found, _NEEDED, "place and way, not what the camera sees", True, False
        )
    share = 100.0 * float(1.0 - way.mean())
    where = f"; items {_number_list(outside)} outside" if outside else "; no item outside"
    why = f"no position by vision on {share:.0f} % of the way: build a larger map or move it"
    return DoctorFinding(_NAME, found + where, _NEEDED, why, False, False)


def _number_list(numbers: Sequence[int]) -> str:
    """Numbers as a list that fits the table."""
    shown = ", ".join(str(n) for n in numbers[:8])
    return shown if len(numbers) <= 8 else f"{shown} and {len(numbers) - 8} more"


def check_origin(origin: OriginConfig, cache: TileCache) -> DoctorFinding:
    """A finding, good if the configured EKF origin is within 50 km and 300 m of height of the map;
    the vehicle accepts no second one.
    """
    m = cache.manifest
    ground = origin.altitude_amsl_m + m.geoid_separation_m
    away_km = _away_km(cache, origin.latitude_deg, origin.longitude_deg)
    bottom, top = m.height_range_m
    off_m = max(bottom - ground, ground - top, 0.0)
    good = away_km <= _ORIGIN_KM and off_m <= _ORIGIN_HEIGHT_M
    found = f"{away_km:.1f} km beside and {off_m:.0f} m above or below the map"
    needed = f"<= {_ORIGIN_KM:.0f} km and {_ORIGIN_HEIGHT_M:.0f} m"
    why = "the take-off ground, altitude AMSL"
    if away_km > _ORIGIN_KM and _is_swapped(cache, origin.latitude_deg, origin.longitude_deg):
        why = "latitude and longitude are swapped: the other way round they are on the map"
    return DoctorFinding("bridge.origin", found, needed, why, good, True)


def check_vehicle_position(cache: TileCache, state: VehicleState) -> list[DoctorFinding]:
    """Findings if the vehicle's GNSS position is off the map, which is then the wrong map; empty if
    it is on the map or unknown.
    """
    latitude_deg, longitude_deg = state.gps_latitude_deg, state.gps_longitude_deg
    if latitude_deg is None or longitude_deg is None or state.gps_fix_type < _FIX_3D:
        return []
    away_km = _away_km(cache, latitude_deg, longitude_deg)
    if away_km <= _STAND_KM:
        return []
    far = away_km > _ORIGIN_KM
    why = "no position by vision here" + (": the map of another place?" if far else "")
    if far and _is_swapped(cache, latitude_deg, longitude_deg):
        why = "the map lies where latitude and longitude are swapped: build it again"
    needed = f"<= {_STAND_KM:g} km"
    return [
        DoctorFinding(
            "vehicle's place", f"{away_km:.1f} km beside the map", needed, why, False, far
        )
    ]


def _away_km(cache: TileCache, latitude_deg: float, longitude_deg: float) -> float:
    """Distance from a position to the rectangle about the map, km; 0 inside."""
    height_m = cache.manifest.origin.height_m
    place = np.asarray(cache.frame.enu_from_geodetic(latitude_deg, longitude_deg, height_m))
    low, high = cache.index.box_min[0, :2], cache.index.box_max[0, :2]
    beside = np.maximum(low - place[:2], place[:2] - high).clip(0.0)
    # On the other side of the Earth a place is near in the plane, and far below it.
    below = max(-float(place[2]) - _BELOW_M, 0.0)
    return float(np.hypot(np.linalg.norm(beside), below)) / 1000


def _is_swapped(cache: TileCache, latitude_deg: float, longitude_deg: float) -> bool:
    if abs(longitude_deg) > 90.0:
        return False
    return _away_km(cache, longitude_deg, latitude_deg) <= _ORIGIN_KM
