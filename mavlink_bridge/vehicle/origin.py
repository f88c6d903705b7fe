"""The firmwares' flat-earth conversions about the EKF origin.

Positions are sent as NED metres from the EKF origin. The flight controller converts them back by
its own approximation, so the same one must be used here.
"""

from __future__ import annotations

import math
from typing import Literal

from mavlink_bridge.messages import Origin

Projection = Literal["ardupilot", "px4"]

# ArduPilot, AP_Common/Location.h: metres per 1e-7 degree of latitude.
METRES_PER_DEGREE = 0.011131884502145034 * 1e7
_PX4_RADIUS_M = 6371000.0  # PX4 lib/geo: CONSTANTS_RADIUS_OF_EARTH


def _longitude_scale(latitude_deg: float) -> float:
    """cos(latitude), floored as ArduPilot's `Location::longitude_scale` does."""
    return max(math.cos(math.radians(latitude_deg)), 0.01)


def wrap_degrees(angle: float) -> float:
    """The same longitude within -180 to 180 degrees."""
    return (angle + 180.0) % 360.0 - 180.0


def north_east(
    origin_lat: float,
    origin_lon: float,
    latitude_deg: float,
    longitude_deg: float,
    projection: Projection = "ardupilot",
) -> tuple[float, float]:
    """(north, east) metres from the origin, in the firmware's own scaling.

    ArduPilot: `Location::get_distance_NE` (longitude scaled at the mean latitude). PX4: azimuthal
    equidistant projection on a sphere (`MapProjection::project`). Latitudes and longitudes in
    degrees.
    """
    d_lon = wrap_degrees(longitude_deg - origin_lon)
    if projection == "ardupilot":
        scale = _longitude_scale((origin_lat + latitude_deg) / 2.0)
        north = (latitude_deg - origin_lat) * METRES_PER_DEGREE
        return north, d_lon * METRES_PER_DEGREE * scale
    lat, ref = math.radians(latitude_deg), math.radians(origin_lat)
    cos_d = math.cos(math.radians(d_lon))
    arc = math.sin(ref) * math.sin(lat) + math.cos(ref) * math.cos(lat) * cos_d
    c = math.acos(max(-1.0, min(1.0, arc)))
    k = c / math.sin(c) if abs(c) > 1e-12 else 1.0
    return (
        k * (math.cos(ref) * math.sin(lat) - math.sin(ref) * math.cos(lat) * cos_d) * _PX4_RADIUS_M,
        k * math.cos(lat) * math.sin(math.radians(d_lon)) * _PX4_RADIUS_M,
    )


def offset(
    origin_lat: float, origin_lon: float, north_m: float, east_m: float
) -> tuple[float, float]:
    """(latitude, longitude) in degrees of the point north_m and east_m from an origin (degrees);
    the inverse of ArduPilot's `north_east`.
    """
    latitude = origin_lat + north_m / METRES_PER_DEGREE
    scale = _longitude_scale((origin_lat + latitude) / 2.0)
    return latitude, wrap_degrees(origin_lon + east_m / (METRES_PER_DEGREE * scale))


def ned_from_origin(
    origin: Origin,
    latitude_deg: float,
    longitude_deg: float,
    altitude_amsl_m: float,
    projection: Projection = "ardupilot",
) -> tuple[float, float, float]:
    """North, east, down from the EKF origin, metres, of an altitude above mean sea level."""
    north, east = north_east(
        origin.latitude_deg, origin.longitude_deg, latitude_deg, longitude_deg, projection
    )
    return north, east, origin.altitude_amsl_m - altitude_amsl_m
