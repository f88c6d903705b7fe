"""Compares the map's heights with the vehicle's GNSS."""

from __future__ import annotations

import math

import numpy as np

from localizer.errors import MapCacheError
from localizer.map.cache.cache import TileCache
from localizer.map.cache.surface import MapSurface
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.preflight.rules import DoctorFinding

_FIX_3D = 3
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
