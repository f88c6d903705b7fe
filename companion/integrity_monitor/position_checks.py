"""Compares vision's position and tilt with other sensors, and watches the EKF for jumps.

Tilt: low over ground with little structure, a tilt and a shift have the same effect on the image:
the position is wrong by the tilt times the height, its motion is nearly right, and the image
matches. The gravity direction of the other sensors shows the tilt.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from companion.integrity_monitor.debouncer import CheckResult
from companion.integrity_monitor.step import UNREPORTED_JUMP_M
from localizer.sensors.error_model import SENSORS
from mavlink_bridge import quaternion as quat
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.messages import Attitude, VehicleState, VisionFix
from mavlink_bridge.vehicle.origin import north_east
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_REFUSED = 1.0  # the innovation test's own threshold
_JUMP_M = 3.0
_FASTEST_MPS2 = 15.0
_GAP_S = 1.0
_CONFIRMS_S = 10.0  # of agreement with the IMU after a jump


class EkfWatch:
    """Checks the EKF's output; called ten times a second with the state, from one thread."""

    def __init__(self) -> None:
        self._last: VehicleState | None = None
        self._unconfirmed_m = 0.0
        self._agreed_since_ns: int | None = None

    def check_rejection(self, state: VehicleState) -> CheckResult:
        """Bad if the EKF's innovation test rejects positions (EKF_STATUS_REPORT, 193)."""
        ratio = state.ekf_horizontal_variance
        if ratio is None or math.isinf(ratio):
            return CheckResult(None)
        return CheckResult(ratio > _REFUSED, ratio)

    def check_jump(self, state: VehicleState, now_ns: int, *, agrees: bool) -> CheckResult:
        """Bad after a jump of the EKF's position (figure: metres), until the IMU has agreed for 10
        s.

        agrees: whether there is evidence that vision moves as the IMU; False without evidence. A
        jump on the ground is ignored, because an EKF jumps from its origin to its first position
        there.
        """
        leap_m = self._leap(state)
        if not state.armed:
            self._unconfirmed_m = 0.0
        elif leap_m > 0.0:
            self._unconfirmed_m, self._agreed_since_ns = leap_m, None
        if not agrees:
            self._agreed_since_ns = None
        elif self._agreed_since_ns is None:
            self._agreed_since_ns = now_ns
        elif now_ns - self._agreed_since_ns >= _CONFIRMS_S * 1e9:
            self._unconfirmed_m = 0.0
        return CheckResult(self._unconfirmed_m > 0.0, self._unconfirmed_m)

    def _leap(self, state: VehicleState) -> float:
        """Distance of the EKF's position from the one predicted by its last velocity, metres; 0 in
        normal flight.
        """
        last = self._last
        if state.local_position_ned is None or state.local_velocity_ned is None:
            self._last = None
            return 0.0
        if last is not None and state.local_time_ns == last.local_time_ns:
            return 0.0
        self._last = state
        if last is None or last.local_position_ned is None or last.local_velocity_ned is None:
            return 0.0
        dt = (state.local_time_ns - last.local_time_ns) * 1e-9
        if not 0.0 < dt < _GAP_S:
            return 0.0
        before, after, speed = (
            last.local_position_ned,
            state.local_position_ned,
            last.local_velocity_ned,
        )
        off = math.hypot(*(after[i] - before[i] - speed[i] * dt for i in range(2)))
        return off if off > _JUMP_M + 0.5 * _FASTEST_MPS2 * dt * dt else 0.0


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


_TILT_SIGMAS, _CALM_SIGMAS = 3.0, 2.0
# Roll and pitch of gimbal and autopilot with mounting, an axis.
_SIGMA_RAD = math.radians(SENSORS.mounted_tilt_deg)
# What is larger is a jump, and held; a gimbal that was knocked costs no more.
_MOST_M = UNREPORTED_JUMP_M
_HOLDS_NS = 1_000_000_000  # without an attitude: a link loses some


class TiltCheck:
    """Compares the tilt of every fix; see the module. It does not estimate a constant bias of the
    gimbal. A wrong tilt that grows slowly from the first fix on (1.5 degrees in 2 s,
    `begins-denied`) would become part of such a bias.
    """

    def __init__(self) -> None:
        self._off_rad = 0.0
        self._share = 0.0  # of its sigma
        self._checked_ns: int | None = None
        self.tilts = False
        """The newest fix is tilted as neither gimbal nor autopilot explain."""
        self.is_known = False
        """Whether there was an attitude of late. What the last one said holds until the next: a
        position is no better because nobody looks.
        """

    @property
    def off_deg(self) -> float:
        """Tilt between vision and autopilot, degrees, of the newest fix with both attitudes."""
        return math.degrees(self._off_rad)

    def metres(self, height_m: float | None) -> float:
        """Position error from the tilt, m: tilt times height above the ground; 0 below 2 sigma of
        the tilt, all of it above 3 sigma. At most a jump (`UNREPORTED_JUMP_M`), as for unknown
        height (None).
        """
        believed = (self._share - _CALM_SIGMAS) / (_TILT_SIGMAS - _CALM_SIGMAS)
        shift_m = _MOST_M if height_m is None else height_m * self._off_rad
        return min(shift_m * min(max(believed, 0.0), 1.0), _MOST_M)

    def add(self, fix: VisionFix, attitude: Attitude | None) -> None:
        """Add a fix. attitude: the autopilot's at its time, None if unknown."""
        if attitude is None or fix.quaternion is None:
            since = self._checked_ns
            self.is_known = since is not None and abs(fix.time_ns - since) <= _HOLDS_NS
            return
        self._checked_ns, self.is_known = fix.time_ns, True
        self._off_rad = math.dist(_level(fix.quaternion), _level(attitude.quaternion))
        self._share = self._off_rad / math.hypot(_SIGMA_RAD, fix.attitude_sigma_rad)
        self.tilts = self._share > (_CALM_SIGMAS if self.tilts else _TILT_SIGMAS)


def _level(ned_from_body: quat.Quaternion) -> tuple[float, float]:
    """The vertical in body axes: forward and right component of the unit vector down."""
    forward, right, _ = quat.rotate(quat.conjugate(ned_from_body), (0.0, 0.0, 1.0))
    return forward, right
