"""Error-state Kalman filter that fuses as ArduPilot's EKF3 does.

It runs at a delayed time horizon (up to 250 ms back) so that late measurements meet the state of
their own time, and carries the result to the present through the buffered IMU increments. Gates,
timeouts, source sets, resets and status flags follow EKF3 4.7: no aiding for 7 s (10 s with
velocity) ends the position flag, 15 s ends aiding, a jump is taken at once only when announced.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from enum import IntEnum, IntFlag
from itertools import count
from math import isfinite, radians, sqrt

import numpy as np

from sitl.embedded import navigation as nav
from sitl.embedded.gated_filter import GatedFilter
from sitl.embedded.geodesy import Location, north_east
from sitl.embedded.measurements import (
    Baro,
    Compass,
    ExternalPosition,
    ExternalVelocity,
    GpsData,
    Measurement,
)
from sitl.embedded.parameters import Parameters
from sitl.embedded.rotation import Array

_MAX_HORIZON_MS = 250
_BASE_HORIZON_MS = 110
_TICK_MS = 10
_MIN_EXTERNAL_INTERVAL_MS = 20
_POSITION_LOST_NO_VELOCITY_MS = 7000
_POSITION_LOST_WITH_VELOCITY_MS = 10000
_ATTITUDE_LOST_MS = 15000
_GPS_GOOD_MS = 10000
_HEIGHT_FRESH_MS = 500
_COMPASS_SIGMA = 0.25  # rad per sample; what EKF3's 0.05 gauss per axis amounts to in heading

# EK3_SRCn_* values
GPS, COMPASS, EXTERNAL = 3, 1, 6

CRITICAL, WARNING, INFO = 2, 4, 6  # MAV_SEVERITY


class Aiding(IntEnum):
    """EKF3's position and velocity aiding mode."""

    NONE = 0
    ABSOLUTE = 1


class EkfFlags(IntFlag):
    """EKF_STATUS_FLAGS of EKF_STATUS_REPORT."""

    ATTITUDE = 1
    VELOCITY_HORIZ = 2
    VELOCITY_VERT = 4
    POS_HORIZ_REL = 8
    POS_HORIZ_ABS = 16
    POS_VERT_ABS = 32
    CONST_POS_MODE = 128
    PRED_POS_HORIZ_REL = 256
    PRED_POS_HORIZ_ABS = 512
    UNINITIALIZED = 1024
    GPS_GLITCHING = 32768


class Estimator(GatedFilter):
    """The vehicle's navigation filter. `notify(severity, text)` sends a STATUSTEXT.

    output: the nominal state (16,) at the present, see `navigation`.
    """

    def __init__(self, parameters: Parameters, notify: Callable[[int, str], None]) -> None:
        super().__init__(parameters)
        self.notify = notify
        self.output: Array = self._state.copy()
        self.origin: Location | None = None
        self.aiding = Aiding.NONE
        self.source_set = 1
        self.armed = False
        self._delay_ticks = self._longest_delay_ms() // _TICK_MS  # EKF3 sizes its buffers at boot
        self._ring = np.zeros((_MAX_HORIZON_MS // _TICK_MS + 2, 7))
        self._start, self._filled = 0, 0
        self._queue: list[tuple[int, int, Measurement]] = []
        self._sequence = count()
        self._last_known_ne = (0.0, 0.0)
        self._aligned = False
        self._last_position_source = -1
        self._last_yaw_source = -1

    # --- input -------------------------------------------------------------------------------

    def align(self, yaw_rad: float) -> None:
        """Initial attitude: level (at rest) and a compass heading."""
        self._state[nav.Q : nav.Q + 4] = (np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2))
        self.output[:] = self._state
        self._cov[2, 2] = 0.1**2
        self._aligned = True

    def add(self, measurement: Measurement, time_ms: int) -> None:
        """Queue a measurement that was taken at time_ms (ms since boot)."""
        if isinstance(measurement, GpsData):
            self._check_gps(measurement)
        heapq.heappush(
            self._queue,
            (max(time_ms, self._horizon_ms()), next(self._sequence), measurement),
        )

    def add_external(self, fix: ExternalPosition, stamp_ms: int) -> bool:
        """A companion's position with its corrected time stamp; False when it is dropped, as it
        is over 50 Hz.
        """
        if not all(isfinite(c) for c in (*fix.position, fix.sigma)):
            return False
        if not self._spaced(stamp_ms - self._clock.external_stamp):
            return False
        self._clock.external_stamp = stamp_ms
        self._clock.external_received = self._now_ms
        self.add(fix, stamp_ms - int(self.parameters["VISO_DELAY_MS"]))
        return True

    def add_external_velocity(self, velocity: ExternalVelocity, stamp_ms: int) -> None:
        """A companion's velocity with its corrected time stamp."""
        if not all(isfinite(c) for c in velocity.velocity):
            return
        if not self._spaced(stamp_ms - self._clock.external_velocity_stamp):
            return
        self._clock.external_velocity_stamp = stamp_ms
        self.add(velocity, stamp_ms - int(self.parameters["VISO_DELAY_MS"]))

    def set_origin(self, origin: Location) -> bool:
        """Set the origin once; a second one is refused, silently, as EKF3 does."""
        if self.origin is not None:
            return False
        self.origin = origin
        for lane in (0, 1):
            self.notify(INFO, f"EKF3 IMU{lane} origin set")
        return True

    def force_position(self, north_m: float, east_m: float, sigma_m: float) -> bool:
        """MAV_CMD_EXTERNAL_POSITION_ESTIMATE: a reset, taken only after 1 s without aiding."""
        if self._now_ms - self._clock.position_pass <= 1000 or self.origin is None:
            return False
        self._reset_position(north_m, east_m, sigma_m**2)
        return True

    # --- output ------------------------------------------------------------------------------

    @property
    def position(self) -> tuple[float, float, float]:
        """NED metres about the origin, now."""
        n, e, d = self.output[nav.P : nav.P + 3]
        return float(n), float(e), float(d)

    @property
    def velocity(self) -> tuple[float, float, float]:
        """NED m/s, now."""
        n, e, d = self.output[nav.V : nav.V + 3]
        return float(n), float(e), float(d)

    @property
    def location(self) -> Location | None:
        """Where the filter says the vehicle is; None without an origin."""
        return self.origin.offset(*self.position) if self.origin else None

    @property
    def position_valid(self) -> bool:
        """Whether a relative or absolute horizontal position is claimed."""
        return self.aiding is Aiding.ABSOLUTE and not self._position_timeout

    @property
    def gps_glitching(self) -> bool:
        """GNSS innovations out of gate for more than a second while GNSS is the source."""
        return (
            not self._innovations_good
            and self.aiding is Aiding.ABSOLUTE
            and self._source("POSXY") == GPS
        )

    @property
    def flags(self) -> EkfFlags:
        """EKF_STATUS_REPORT flags."""
        if not self._aligned:
            return EkfFlags.UNINITIALIZED
        flags = EkfFlags.ATTITUDE | EkfFlags.VELOCITY_VERT | EkfFlags.POS_VERT_ABS
        unaided = self.aiding is Aiding.NONE  # then a constant position is fused, and counts
        if unaided or not (self._velocity_timeout and self._position_timeout):
            flags |= EkfFlags.VELOCITY_HORIZ
        if self.position_valid:
            flags |= (
                EkfFlags.POS_HORIZ_REL
                | EkfFlags.POS_HORIZ_ABS
                | EkfFlags.PRED_POS_HORIZ_REL
                | EkfFlags.PRED_POS_HORIZ_ABS
            )
        if unaided:
            flags |= EkfFlags.CONST_POS_MODE
        if self.gps_glitching:
            flags |= EkfFlags.GPS_GLITCHING
        return flags

    @property
    def variances(self) -> tuple[float, float, float, float]:
        """Velocity, position, height and compass variances as EKF_STATUS_REPORT carries them."""
        r = self.ratios
        return sqrt(r.velocity), sqrt(r.position), sqrt(r.height), sqrt(r.yaw)

    def accuracy(self) -> tuple[float, float, float]:
        """One-sigma horizontal position, vertical position and horizontal speed (m, m, m/s)."""
        c = self._cov
        return (
            sqrt(c[6, 6] + c[7, 7]),
            sqrt(c[8, 8]),
            sqrt(c[3, 3] + c[4, 4]),
        )

    # --- one tick ----------------------------------------------------------------------------

    def update(self, increment: Array, now_ms: int) -> None:
        """Take one 10 ms IMU increment: advance the horizon, fuse what is due, refresh output."""
        self._now_ms = now_ms
        size = self._ring.shape[0]
        self._ring[(self._start + self._filled) % size] = increment
        self._filled += 1
        p = self.parameters
        noise = np.array(
            [p["EK3_GYRO_P_NSE"], p["EK3_ACC_P_NSE"], p["EK3_GBIAS_P_NSE"], p["EK3_ABIAS_P_NSE"]]
        )
        while self._filled > self._delay_ticks:
            nav.predict(self._state, self._cov, self._ring[self._start], noise)
            self._start = (self._start + 1) % size
            self._filled -= 1
            self._fuse_due()
        nav.replay(self._state, self._ring, self._start, self._filled, self.output)

    def _longest_delay_ms(self) -> int:
        delay = _BASE_HORIZON_MS
        if self.parameters["VISO_TYPE"] > 0:
            delay = max(delay, int(self.parameters["VISO_DELAY_MS"]))
        if self.parameters["GPS1_TYPE"] > 0:
            delay = max(delay, int(self.parameters["GPS1_DELAY_MS"]), 200)
        return min(delay, _MAX_HORIZON_MS)

    def _horizon_ms(self) -> int:
        return self._now_ms - self._filled * _TICK_MS

    def _fuse_due(self) -> None:
        self._check_sources()
        self._update_aiding()
        while self._queue and self._queue[0][0] <= self._horizon_ms():
            measurement = heapq.heappop(self._queue)[2]
            if isinstance(measurement, Baro):
                self._fuse_baro(measurement.height)
            elif isinstance(measurement, Compass):
                if self._source("YAW") == COMPASS:
                    self._fuse_yaw(measurement.yaw, _COMPASS_SIGMA)
            elif isinstance(measurement, GpsData):
                self._use_gps(measurement)
            elif isinstance(measurement, ExternalPosition):
                self._use_external(measurement)
            else:
                self._use_external_velocity(measurement)

    # --- sources and aiding ------------------------------------------------------------------

    def _source(self, what: str) -> int:
        return int(self.parameters[f"EK3_SRC{self.source_set}_{what}"])

    @staticmethod
    def _spaced(interval_ms: int) -> bool:
        # A stamp that goes back means the sender started anew.
        return interval_ms >= _MIN_EXTERNAL_INTERVAL_MS or interval_ms < 0

    def _check_sources(self) -> None:
        position, yaw = self._source("POSXY"), self._source("YAW")
        if position != self._last_position_source:
            self._source_reset = self._last_position_source >= 0 and position != 0
            self._last_position_source = position
        if yaw != self._last_yaw_source:
            self._yaw_reset = self._last_yaw_source >= 0
            self._last_yaw_source = yaw

    def _check_gps(self, gps: GpsData) -> None:
        now = self._now_ms
        good = (
            gps.satellites >= 6
            and gps.hdop <= 2.5
            and gps.horizontal_accuracy <= 5.0
            and gps.speed_accuracy <= 1.5
        )
        if not good or now - self._clock.gps_received > 1000:
            self._clock.gps_bad = now
        self._clock.gps_received = now
        self._gps_fix_good = now - self._clock.gps_bad >= _GPS_GOOD_MS
        if self._gps_fix_good and self.origin is None:
            height = -float(self._state[nav.P + 2])
            self.set_origin(Location(gps.latitude_deg, gps.longitude_deg, gps.altitude_m - height))

    def _start_aiding(self, source: str) -> None:
        self.aiding = Aiding.ABSOLUTE
        self._position_timeout = self._velocity_timeout = False
        self._clock.position_pass = self._clock.velocity_pass = self._now_ms
        for lane in (0, 1):
            self.notify(INFO, f"EKF3 IMU{lane} is using {source}")

    def _update_aiding(self) -> None:
        if self.aiding is not Aiding.ABSOLUTE:
            return
        now, clock = self._now_ms, self._clock
        position_used = now - clock.position_pass <= _POSITION_LOST_NO_VELOCITY_MS
        velocity_used = now - clock.velocity_pass <= _POSITION_LOST_NO_VELOCITY_MS
        self._velocity_aiding = position_used or velocity_used
        silent = now - max(clock.position_pass, clock.velocity_pass)
        if silent > _ATTITUDE_LOST_MS:
            self._stop_aiding()
        elif not position_used:
            limit = (
                _POSITION_LOST_WITH_VELOCITY_MS
                if self._velocity_aiding
                else _POSITION_LOST_NO_VELOCITY_MS
            )
            if now - clock.position_pass > limit:
                self._position_timeout = True
                self._velocity_timeout = not velocity_used

    def _stop_aiding(self) -> None:
        self.aiding = Aiding.NONE
        self._position_timeout = self._velocity_timeout = True
        self._last_known_ne = (float(self._state[nav.P]), float(self._state[nav.P + 1]))
        self._state[nav.V : nav.V + 2] = 0.0
        nav.reset_error(self._cov, 3, 2, self.parameters["EK3_VELNE_M_NSE"] ** 2)
        self.ratios.position = self.ratios.velocity = 0.0
        for lane in (0, 1):
            self.notify(WARNING, f"EKF3 IMU{lane} stopped aiding")

    # --- fusion ------------------------------------------------------------------------------

    def _use_gps(self, gps: GpsData) -> None:
        self._note_innovations()
        if self._source("YAW") == 2 and gps.yaw_rad is not None:
            self._fuse_yaw(gps.yaw_rad, radians(10.0))
        if self._source("POSXY") != GPS or self.origin is None:
            return
        position = north_east(self.origin, gps.latitude_deg, gps.longitude_deg)
        sigma = max(gps.horizontal_accuracy, self.parameters["EK3_POSNE_M_NSE"])
        horizontal = gps.horizontal_velocity if self._source("VELXY") == GPS else None
        vertical = gps.vertical_velocity if self._source("VELZ") == GPS else None
        if self.aiding is Aiding.NONE:
            if not (self._gps_fix_good and self._aligned):
                return
            self._start_aiding("GPS")
            self._reset_position(*position, sigma**2)
            self._reset_velocity(horizontal or (0.0, 0.0), 0.5**2 if horizontal else 25.0)
            return
        if self._source_reset:
            self._reset_position(*position, sigma**2)
        speed = max(gps.speed_accuracy, self.parameters["EK3_VELNE_M_NSE"])
        self._fuse_position(position, sigma, horizontal)
        if horizontal is not None:
            self._fuse_velocity(horizontal, vertical, speed, self.parameters["EK3_VELNE_M_NSE"])
        elif vertical is not None:
            nav.fuse(self._state, self._cov, 5, vertical - self._state[nav.V + 2], 0.5**2)
        if self._source("POSZ") == GPS:
            self._fuse_height(gps.altitude_m - self.origin.altitude_m, 1.5)

    def _use_external(self, fix: ExternalPosition) -> None:
        if self._source("YAW") == EXTERNAL and fix.yaw_rad is not None:
            if self._yaw_reset:
                self._rotate_to(fix.yaw_rad, fix.yaw_sigma)
            else:
                self._fuse_yaw(fix.yaw_rad, fix.yaw_sigma)
        if self._source("POSXY") != EXTERNAL:
            return
        north, east, down = fix.position
        if self.aiding is Aiding.NONE:
            if not self._aligned:
                return
            self._start_aiding("external nav data")
            for lane in (0, 1):
                text = f"initial pos NED = {north:3.1f},{east:3.1f},{down:3.1f} (m)"
                self.notify(INFO, f"EKF3 IMU{lane} {text}")
            self._reset_position(north, east, fix.sigma**2)
            self._reset_velocity((0.0, 0.0), 25.0)
            return
        if fix.reset or self._source_reset:
            self._reset_position(north, east, None)
            if self._source("POSZ") == EXTERNAL:
                self._state[nav.P + 2] = down
        self._fuse_position((north, east), fix.sigma, None)
        if self._source("POSZ") == EXTERNAL:
            self._fuse_height(-down, max(fix.sigma, 0.1))

    def _use_external_velocity(self, observed: ExternalVelocity) -> None:
        if self._source("VELXY") != EXTERNAL or self.aiding is Aiding.NONE:
            return
        vertical = observed.velocity[2] if self._source("VELZ") == EXTERNAL else None
        horizontal = (observed.velocity[0], observed.velocity[1])
        self._fuse_velocity(horizontal, vertical, observed.sigma, observed.sigma)

    def _fuse_baro(self, height: float) -> None:
        source = self._source("POSZ")
        external_fresh = (
            source == EXTERNAL and self._now_ms - self._clock.external_received < _HEIGHT_FRESH_MS
        )
        gps_fresh = (
            source == GPS
            and self._now_ms - self._clock.gps_received < _HEIGHT_FRESH_MS
            and self.aiding is Aiding.ABSOLUTE
        )
        if not (external_fresh or gps_fresh):
            self._fuse_height(height, self.parameters["EK3_ALT_M_NSE"])
        if self.aiding is Aiding.NONE:
            # As EKF3: hold position with a synthetic measurement, to keep the tilt bounded.
            sigma = self.parameters["EK3_NOAID_M_NSE"] if self.armed else 0.5
            for i in range(2):
                residual = self._last_known_ne[i] - self._state[nav.P + i]
                nav.fuse(self._state, self._cov, 6 + i, residual, sigma**2)
