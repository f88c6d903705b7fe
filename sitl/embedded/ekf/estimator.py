"""Error-state Kalman filter that fuses as ArduPilot's EKF3 does.

It runs at a delayed time horizon (up to 250 ms back) so that late measurements meet the state of
their own time, and carries the result to the present through the buffered IMU increments. What is
fused, and when it is accepted, is in `aided_filter`.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from enum import IntFlag
from itertools import count
from math import isfinite, sqrt

import numpy as np

from sitl.embedded.ekf import navigation as nav
from sitl.embedded.ekf.aided_filter import GPS, AidedFilter, Aiding
from sitl.embedded.ekf.ekf2_filter import Ekf2Filter
from sitl.embedded.ekf.measurements import ExternalPosition, ExternalVelocity, GpsData, Measurement
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.rotation import Array
from sitl.geodesy import Location

_MAX_HORIZON_MS = 250
_BASE_HORIZON_MS = 110
_TICK_MS = 10
_DELTA_FRESH_MS = 5000  # of a change of the position, as EKF3 has it for body odometry
_MIN_EXTERNAL_INTERVAL_MS = 20


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


class Estimator:
    """The vehicle's EKF.

    output: the nominal state (16,) at the present, see `navigation`. sources: the filter that
    selects and fuses measurements.
    """

    def __init__(self, parameters: Parameters, notify: Callable[[int, str], None]) -> None:
        self._parameters = parameters
        chosen = Ekf2Filter if parameters.is_px4 else AidedFilter
        self.sources: AidedFilter = chosen(parameters, notify)
        self._gated = self.sources.gated
        self.output: Array = self._gated.state.copy()
        self._delay_ticks = self._longest_delay_ms() // _TICK_MS  # EKF3 sizes its buffers at boot
        self._ring = np.zeros((_MAX_HORIZON_MS // _TICK_MS + 2, 7))
        self._start, self._filled = 0, 0
        self._queue: list[tuple[int, int, Measurement]] = []
        self._sequence = count()

    # --- input -------------------------------------------------------------------------------

    def align(self, yaw_rad: float) -> None:
        """Set the initial attitude: level, with a compass heading from true north."""
        self._gated.state[nav.Q : nav.Q + 4] = (np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2))
        self.output[:] = self._gated.state
        self._gated.cov[2, 2] = 0.1**2
        self.sources.aligned = True

    def set_origin(self, origin: Location) -> bool:
        """Set the origin once; False for a second one."""
        return self.sources.set_origin(origin)

    def add(self, measurement: Measurement, time_ms: int) -> None:
        """Queue a measurement taken at time_ms since boot (at the delayed horizon if older). GNSS
        is checked at once, and may set the origin.
        """
        if isinstance(measurement, GpsData):
            self.sources.check_gps(measurement)
        heapq.heappush(
            self._queue,
            (max(time_ms, self._horizon_ms()), next(self._sequence), measurement),
        )

    def add_external(self, fix: ExternalPosition, stamp_ms: int) -> bool:
        """Queue a companion's position. stamp_ms: its timestamp in ms since boot, before
        VISO_DELAY_MS is subtracted. False if it is dropped: not finite, or above the 50 Hz limit.
        """
        if not all(isfinite(c) for c in (*fix.position, fix.sigma)):
            return False
        if not self._spaced(stamp_ms - self._gated.clock.external_stamp):
            return False
        self._gated.clock.external_stamp = stamp_ms
        self._gated.clock.external_received = self._gated.now_ms
        self.add(fix, stamp_ms - int(self._parameters["VISO_DELAY_MS"]))
        return True

    def add_external_velocity(self, velocity: ExternalVelocity, stamp_ms: int) -> None:
        """Queue a companion's velocity, with the same timestamp and limits as `add_external`."""
        if not all(isfinite(c) for c in velocity.velocity):
            return
        if not self._spaced(stamp_ms - self._gated.clock.external_velocity_stamp):
            return
        self._gated.clock.external_velocity_stamp = stamp_ms
        self.add(velocity, stamp_ms - int(self._parameters["VISO_DELAY_MS"]))

    # --- output ------------------------------------------------------------------------------

    @property
    def origin(self) -> Location | None:
        """Origin of the local frame; None until it is set."""
        return self.sources.origin

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
        """Estimated location; None without an origin."""
        return self.origin.offset(*self.position) if self.origin else None

    @property
    def position_valid(self) -> bool:
        """Whether the flags claim a relative or absolute horizontal position."""
        since_ms = self._gated.now_ms - self._gated.clock.position_delta
        holds = self.sources.aiding is Aiding.ABSOLUTE and since_ms < _DELTA_FRESH_MS
        return self._is_absolute or holds

    @property
    def _is_absolute(self) -> bool:
        return self.sources.aiding is Aiding.ABSOLUTE and not self._gated.position_timeout

    @property
    def gps_glitching(self) -> bool:
        """Whether GNSS, the active source, has been outside the gate for more than a second."""
        return (
            not self._gated.innovations_good
            and self.sources.aiding is Aiding.ABSOLUTE
            and self.sources.source("POSXY") == GPS
        )

    @property
    def flags(self) -> EkfFlags:
        """EKF_STATUS_REPORT flags."""
        if not self.sources.aligned:
            return EkfFlags.UNINITIALIZED
        flags = EkfFlags.ATTITUDE | EkfFlags.VELOCITY_VERT | EkfFlags.POS_VERT_ABS
        unaided = (
            self.sources.aiding is Aiding.NONE
        )  # then a constant position is fused, and counts
        if unaided or not (self._gated.velocity_timeout and self._gated.position_timeout):
            flags |= EkfFlags.VELOCITY_HORIZ
        if self.position_valid:
            flags |= EkfFlags.POS_HORIZ_REL | EkfFlags.PRED_POS_HORIZ_REL
        if self._is_absolute:
            flags |= EkfFlags.POS_HORIZ_ABS | EkfFlags.PRED_POS_HORIZ_ABS
        if unaided:
            flags |= EkfFlags.CONST_POS_MODE
        if self.gps_glitching:
            flags |= EkfFlags.GPS_GLITCHING
        return flags

    @property
    def variances(self) -> tuple[float, float, float, float]:
        """EKF_STATUS_REPORT's test ratios of velocity, position, height, compass; 1 is the gate."""
        r = self._gated.ratios
        return sqrt(r.velocity), sqrt(r.position), sqrt(r.height), sqrt(r.yaw)

    def accuracy(self) -> tuple[float, float, float]:
        """One-sigma horizontal position, vertical position and horizontal speed (m, m, m/s)."""
        c = self._gated.cov
        return (
            sqrt(c[6, 6] + c[7, 7]),
            sqrt(c[8, 8]),
            sqrt(c[3, 3] + c[4, 4]),
        )

    # --- one tick ----------------------------------------------------------------------------

    def update(self, increment: Array, now_ms: int) -> None:
        """Process a tick's 10 ms IMU increment: propagate, fuse what is due, update `output`."""
        self._gated.now_ms = now_ms
        size = self._ring.shape[0]
        self._ring[(self._start + self._filled) % size] = increment
        self._filled += 1
        p = self._parameters
        noise = np.array(
            [p["EK3_GYRO_P_NSE"], p["EK3_ACC_P_NSE"], p["EK3_GBIAS_P_NSE"], p["EK3_ABIAS_P_NSE"]]
        )
        while self._filled > self._delay_ticks:
            nav.predict(self._gated.state, self._gated.cov, self._ring[self._start], noise)
            self._start = (self._start + 1) % size
            self._filled -= 1
            self._fuse_due()
        nav.replay(self._gated.state, self._ring, self._start, self._filled, self.output)

    def _longest_delay_ms(self) -> int:
        if self._parameters.is_px4:
            return min(int(self._parameters["EKF2_DELAY_MAX"]), _MAX_HORIZON_MS)
        delay = _BASE_HORIZON_MS
        if self._parameters["VISO_TYPE"] > 0:
            delay = max(delay, int(self._parameters["VISO_DELAY_MS"]))
        if self._parameters["GPS1_TYPE"] > 0:
            delay = max(delay, int(self._parameters["GPS1_DELAY_MS"]), 200)
        return min(delay, _MAX_HORIZON_MS)

    def _horizon_ms(self) -> int:
        return self._gated.now_ms - self._filled * _TICK_MS

    def _fuse_due(self) -> None:
        self.sources.check_sources()
        self.sources.update_aiding()
        while self._queue and self._queue[0][0] <= self._horizon_ms():
            self.sources.fuse(heapq.heappop(self._queue)[2])

    @staticmethod
    def _spaced(interval_ms: int) -> bool:
        # A stamp that goes back means the sender started anew.
        return interval_ms >= _MIN_EXTERNAL_INTERVAL_MS or interval_ms < 0
