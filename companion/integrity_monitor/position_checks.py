"""Compares vision's position with barometer and GNSS."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from companion.integrity_monitor.debouncer import CheckResult
from localizer.sensors.error_model import SENSORS
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.messages import VehicleState, VisionFix
from mavlink_bridge.vehicle.origin import north_east
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_HEIGHT_M = 8.0  # largest height difference to the barometer
_RECEIVER_M = 3.0  # largest receiver error that is believed
_FORGET_S = 120.0  # the barometer's drift against vision: its zero follows with this time
_MEDIAN_OF = 15
_BARO_FRESH_NS = 1_000_000_000
_FIX_FRESH_NS = 500_000_000
_SIGMAS = 4.0
_GNSS_AGE_S = 0.2  # of a report when it comes, beyond what its four sigmas cover


class LocalPlace:
    """Converts positions to north and east of the first fix."""

    def __init__(self) -> None:
        self._anchor: tuple[float, float] | None = None

    def ned(self, fix: VisionFix) -> tuple[float, float, float]:
        """The fix's position: north and east from the first one's, down from the ellipsoid, m."""
        north, east = self.north_east(fix.latitude_deg, fix.longitude_deg)
        return north, east, -fix.height_m

    def north_east(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """North and east from the first position, m; the first call (also of `ned`) sets it."""
        if self._anchor is None:
            self._anchor = (latitude_deg, longitude_deg)
        return north_east(*self._anchor, latitude_deg, longitude_deg)


class HeightCheck:
    """Compares vision's height with the barometer's. Both are relative to their first common value
    in this flight, because pressure and temperature change between flights.
    """

    def __init__(self) -> None:
        self._zero: float | None = None
        self._altitude_m = 0.0  # that the zero is of
        self._last_ns = 0
        self._differences: deque[float] = deque(maxlen=_MEDIAN_OF)

    def add(self, fix: VisionFix, state: VehicleState) -> CheckResult:
        """Add a fix and the state of about its time. Figure: difference of the heights, m. Disarmed
        it is good and forgets the common value, which takes 15 fixes to find.
        """
        if not state.armed:
            self._zero = None
            self._differences.clear()
            return CheckResult(False)
        altitude = state.pressure_altitude_m
        if altitude is None or abs(fix.time_ns - state.pressure_time_ns) > _BARO_FRESH_NS:
            return CheckResult(None)
        difference = fix.height_m - altitude
        self._differences.append(difference)
        median = float(np.median(self._differences))
        if self._zero is None:
            if len(self._differences) == _MEDIAN_OF:
                self._zero, self._altitude_m, self._last_ns = median, altitude, fix.time_ns
            return CheckResult(None)
        dt = min(max((fix.time_ns - self._last_ns) * 1e-9, 0.0), 1.0)
        self._last_ns = fix.time_ns
        apart = median - self._zero
        sigma = fix.vertical_sigma_m
        climbed_m = altitude - self._altitude_m
        bad = abs(apart) > _HEIGHT_M + _SIGMAS * sigma + SENSORS.climb_share * abs(climbed_m)
        if not bad:
            self._zero += apart * dt / _FORGET_S
            self._altitude_m += climbed_m * dt / _FORGET_S
        return CheckResult(bad, abs(apart))


class GnssCheck:
    """Compares GNSS with vision in every mode, while GNSS is healthy. Either may be wrong."""

    def read(
        self, fix: VisionFix, state: VehicleState, protection_m: float, now_ns: int
    ) -> CheckResult:
        """Compare the newest fix with GNSS. Figure: distance, m. No evidence unless GNSS is healthy
        and its position within 0.5 s of the fix. protection_m: the fix's horizontal level.
        """
        latitude, longitude = state.gps_latitude_deg, state.gps_longitude_deg
        if latitude is None or longitude is None or not gnss_healthy(state, now_ns):
            return CheckResult(None)
        if abs(state.gps_time_ns - fix.time_ns) > _FIX_FRESH_NS:
            return CheckResult(None)
        place = LocalPlace()
        place.ned(fix)
        north, east = place.north_east(latitude, longitude)
        accuracy = VEHICLE_SENSORS.gnss_sigma_m(state.gps_h_accuracy_m, _RECEIVER_M)
        v_north, v_east, _ = state.local_velocity_ned or (0.0, 0.0, 0.0)
        later_s = (fix.time_ns - state.gps_time_ns) * 1e-9
        apart = math.hypot(north + v_north * later_s, east + v_east * later_s)
        limit = _SIGMAS * accuracy + protection_m + _GNSS_AGE_S * math.hypot(v_north, v_east)
        return CheckResult(apart > limit, apart)
