"""The EKF origin, and the firmwares' flat-earth conversions.

Positions are sent as NED metres from the EKF origin. The flight controller converts them back by
its own approximation, so the same one must be used here.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import OriginConfig
from mavlink_bridge.messages import Origin

_log = logging.getLogger(__name__)

Projection = Literal["ardupilot", "px4"]

# ArduPilot, AP_Common/Location.h: metres per 1e-7 degree of latitude.
METRES_PER_DEGREE = 0.011131884502145034 * 1e7
_PX4_RADIUS_M = 6371000.0  # PX4 lib/geo: CONSTANTS_RADIUS_OF_EARTH
_HIGHEST_M = 20_000.0  # of an origin, or as deep below the sea
_ASK_EVERY_NS = 1_000_000_000
_CHECK_EVERY_NS = 10_000_000_000
_ASKS_BEFORE_SETTING = 3


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


def _is_plausible(read: Origin) -> bool:
    """Whether it is an origin on Earth, and not 0, 0, which firmwares send before they have one."""
    if read.latitude_deg == 0.0 and read.longitude_deg == 0.0:
        return False
    if not abs(read.altitude_amsl_m) <= _HIGHEST_M:
        return False
    return abs(read.latitude_deg) <= 90.0 and abs(read.longitude_deg) <= 180.0


def _distance_m(a: Origin, b: Origin) -> float:
    north, east = north_east(a.latitude_deg, a.longitude_deg, b.latitude_deg, b.longitude_deg)
    return math.hypot(north, east, b.altitude_amsl_m - a.altitude_amsl_m)


class OriginKeeper:
    """Reads the vehicle's EKF origin, and sets the configured one only if there is none.

    ArduPilot silently ignores a second origin, so only GPS_GLOBAL_ORIGIN shows the origin in use.
    """

    def __init__(self, configured: OriginConfig | None) -> None:
        self.origin: Origin | None = None
        self._configured = configured
        self._asked = 0
        self._next_ns = 0
        self._told = False
        self.moved_m: float | None = None
        """Distance of the last received origin from the known one, m, if it was refused; else None.
        """

    def reset(self) -> None:
        """Forget the origin and ask again: the flight controller rebooted, or may have."""
        self.origin, self._asked, self._told, self._next_ns = None, 0, False, 0
        self.moved_m = None

    def on_origin(self, message: Any, *, armed: bool) -> Alert | None:
        """Process GPS_GLOBAL_ORIGIN; returns an alert if the origin is new or changed.

        armed: a known origin is then kept. No EKF moves its origin in flight, and a forged origin
        would shift every position.
        """
        read = Origin(message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3)
        self.moved_m = None
        if not _is_plausible(read) or read == self.origin:
            return None
        moved = self.origin is not None
        if self.origin is not None and armed:
            self.moved_m = _distance_m(self.origin, read)
            return None
        self.origin = read
        if moved:
            return alert(AlertId.ORIGIN_MOVED)
        if self._configured is not None:
            north, east = north_east(
                self._configured.latitude_deg,
                self._configured.longitude_deg,
                read.latitude_deg,
                read.longitude_deg,
            )
            apart = math.hypot(north, east)
            if apart > 1.0:
                return alert(AlertId.ORIGIN_DIFFERS, metres=apart)
        return alert(AlertId.ORIGIN_KNOWN)

    def tick(self, now_ns: int, system_id: int, ask: Callable[[int], None]) -> Any | None:
        """Request the origin by `ask(49)`. Returns SET_GPS_GLOBAL_ORIGIN if it is due: after three
        requests without an origin, if one is configured.
        """
        if now_ns < self._next_ns:
            return None
        if self.origin is not None:
            self._next_ns = now_ns + _CHECK_EVERY_NS
            ask(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
            return None
        self._next_ns = now_ns + _ASK_EVERY_NS
        self._asked += 1
        ask(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        # After setting, one more question: the answer may be under way.
        patient = self._asked <= _ASKS_BEFORE_SETTING or self._asked % 2 == 1
        if self._configured is None or patient:
            return None
        if not self._told:
            _log.info("the vehicle has no EKF origin: setting the configured one")
            self._told = True
        return mavlink.MAVLink_set_gps_global_origin_message(
            system_id,
            round(self._configured.latitude_deg * 1e7),
            round(self._configured.longitude_deg * 1e7),
            round(self._configured.altitude_amsl_m * 1e3),
            now_ns // 1000,
        )
