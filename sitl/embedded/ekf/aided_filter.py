"""The EKF's gates, sensor source selection, and start and end of aiding, as in EKF3 4.7.

Without aiding for 7 s (10 s with velocity) the position flag ends; after 15 s aiding ends. A jump
is accepted at once only if it is announced.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from math import radians

import numpy as np

from sitl.embedded.ekf import navigation as nav
from sitl.embedded.ekf.measurements import (
    Baro,
    Compass,
    ExternalPosition,
    ExternalVelocity,
    GpsData,
    Measurement,
)
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.rotation import euler, rotate_world, wrap_pi
from sitl.embedded.severity import INFO, WARNING
from sitl.geodesy import Location, north_east


@dataclass
class TestRatios:
    """Squared ratio of innovation to gate; below 1 a measurement is inside the gate."""

    velocity: float = 0.0
    position: float = 0.0
    height: float = 0.0
    yaw: float = 0.0


@dataclass
class FilterClock:
    """Times of the last events, ms since boot; -1,000,000: never."""

    position_pass: int = -1_000_000
    velocity_pass: int = -1_000_000
    gps_received: int = -1_000_000
    gps_bad: int = 0
    external_stamp: int = -1_000_000
    external_velocity_stamp: int = -1_000_000
    external_received: int = -1_000_000
    position_delta: int = -1_000_000
    innovation_pass: int = 0
    innovation_fail: int = -1_000_000


class GatedFilter:
    """State and covariance with gated updates. Times are ms since boot.

    state: nominal state (16,), cov: (15, 15), see `navigation`, at the delayed time horizon.
    now_ms: the present. position_timeout, velocity_timeout: whether no measurement was inside the
    gate for so long that the next one resets the state.
    """

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters
        self.ratios = TestRatios()
        self.state = np.zeros(nav.NOMINAL_SIZE)
        self.state[nav.Q] = 1.0
        self.cov = np.diag(
            np.repeat([0.02**2, 0.5**2, 0.5**2, 0.005**2, 0.05**2], 3).astype(np.float64)
        )
        self.now_ms = 0
        self.clock = FilterClock()
        self.position_timeout = True
        self.velocity_timeout = True
        self.velocity_aiding = False
        self.innovations_good = True
        self.gps_fix_good = False
        self.source_reset = False
        self.yaw_reset = False

    def fuse_position(
        self,
        position: tuple[float, float],
        sigma: float,
        velocity: tuple[float, float] | None,
    ) -> None:
        """Fuse a position (north, east; m from the origin; sigma m) if it is inside the gate; after
        a timeout, reset the position to it instead. velocity: (north, east) m/s for that reset;
        None: not measured. Sets `ratios.position` and the time of the last pass.
        """
        p = self.parameters
        innovation = [position[i] - float(self.state[nav.P + i]) for i in range(2)]
        variance = self.cov[6, 6] + self.cov[7, 7]
        gate = max(0.01 * p["EK3_POS_I_GATE"], 1.0) ** 2
        ratio = (innovation[0] ** 2 + innovation[1] ** 2) / (gate * (variance + 2 * sigma**2))
        self.ratios.position = ratio
        passed = ratio < 1.0
        if passed:
            self.clock.position_pass = self.now_ms
        if not (passed or self.position_timeout):
            return
        radius = p["EK3_GLITCH_RAD"]
        lost = self.position_timeout or variance > radius**2
        if lost and (not self.velocity_aiding or self.gps_fix_good):
            self.reset_position(*position, (0.5 * radius) ** 2)
            self.position_timeout = False
            self.clock.position_pass = self.now_ms
            self.ratios.position = 0.0
            if self.velocity_timeout:
                self.reset_velocity(velocity or (0.0, 0.0), 0.5**2 if velocity else 25.0**2)
            return
        for i in range(2):
            residual = position[i] - self.state[nav.P + i]
            nav.fuse(self.state, self.cov, 6 + i, residual, sigma**2)

    def fuse_velocity(
        self,
        horizontal: tuple[float, float],
        vertical: float | None,
        sigma: float,
        gate_sigma: float,
    ) -> None:
        """Fuse north, east and (unless None) down velocity, m/s, if it is inside the gate; after a
        timeout, reset the horizontal velocity to it instead. sigma: of the measurement, gate_sigma:
        for the gate, both m/s. Sets `ratios.velocity` and the time of the last pass.
        """
        observed = [*horizontal] if vertical is None else [*horizontal, vertical]
        squared, variance = 0.0, 0.0
        for i, value in enumerate(observed):
            squared += (value - float(self.state[nav.V + i])) ** 2
            variance += self.cov[3 + i, 3 + i] + gate_sigma**2
        gate = max(0.01 * self.parameters["EK3_VEL_I_GATE"], 1.0) ** 2
        self.ratios.velocity = squared / (gate * variance)
        passed = self.ratios.velocity < 1.0
        if passed:
            self.clock.velocity_pass = self.now_ms
        elif self.velocity_timeout:
            self.reset_velocity(horizontal, sigma**2)
            self.ratios.velocity = 0.0
            return
        else:
            return
        for i, value in enumerate(observed):
            nav.fuse(self.state, self.cov, 3 + i, value - self.state[nav.V + i], sigma**2)

    def fuse_height(self, height: float, sigma: float) -> None:
        """Fuse a height above the origin (m, sigma m) if it is inside the gate. Sets
        `ratios.height`.
        """
        innovation = -height - float(self.state[nav.P + 2])
        variance = self.cov[8, 8] + sigma**2
        gate = max(0.01 * self.parameters["EK3_HGT_I_GATE"], 1.0) ** 2
        self.ratios.height = innovation**2 / (gate * variance)
        if self.ratios.height < 1.0:
            nav.fuse(self.state, self.cov, 8, innovation, sigma**2)

    def fuse_yaw(self, yaw_rad: float, sigma: float) -> None:
        """Fuse a heading (radians clockwise from true north, sigma rad) if it is inside the gate.
        Sets `ratios.yaw`.
        """
        innovation = wrap_pi(yaw_rad - euler(self.state[nav.Q : nav.Q + 4])[2])
        variance = self.cov[2, 2] + sigma**2
        gate = max(0.01 * self.parameters["EK3_YAW_I_GATE"], 1.0) ** 2
        self.ratios.yaw = innovation**2 / (gate * variance)
        if self.ratios.yaw < 1.0:
            nav.fuse(self.state, self.cov, 2, innovation, sigma**2)

    def rotate_to(self, yaw_rad: float, sigma: float) -> None:
        """Reset the heading to yaw_rad (clockwise from true north) with the given sigma (rad). Roll
        and pitch stay; a requested yaw reset is done.
        """
        self.yaw_reset = False
        change = wrap_pi(yaw_rad - euler(self.state[nav.Q : nav.Q + 4])[2])
        rotate_world(self.state[nav.Q : nav.Q + 4], 0.0, 0.0, change)
        nav.reset_error(self.cov, 2, 1, sigma**2)

    def reset_position(self, north: float, east: float, variance: float | None) -> None:
        """Set north and east, m. variance None keeps the covariance (EKF3's announced reset)."""
        self.source_reset = False
        self.state[nav.P : nav.P + 2] = (north, east)
        if variance is not None:
            nav.reset_error(self.cov, 6, 2, variance)
            self.clock.position_pass = self.now_ms
            self.position_timeout = False

    def reset_velocity(self, horizontal: tuple[float, float], variance: float) -> None:
        """Set the horizontal velocity (north, east m/s) and its variance."""
        self.state[nav.V : nav.V + 2] = horizontal
        nav.reset_error(self.cov, 3, 2, variance)
        self.velocity_timeout = False
        self.clock.velocity_pass = self.now_ms

    def update_innovation_status(self) -> None:
        """Update `innovations_good`: False after 1 s in which position or velocity was outside the
        gate, True again after 10 s with both inside.
        """
        clock, now = self.clock, self.now_ms
        if self.ratios.position < 1.0 and self.ratios.velocity < 1.0:
            clock.innovation_pass = now
        else:
            clock.innovation_fail = now
        if now - clock.innovation_pass > 1000:
            self.innovations_good = False
        elif now - clock.innovation_fail > 10000:
            self.innovations_good = True


_POSITION_LOST_NO_VELOCITY_MS = 7000
_POSITION_LOST_WITH_VELOCITY_MS = 10000
_ATTITUDE_LOST_MS = 15000
_GPS_GOOD_MS = 10000
_HEIGHT_FRESH_MS = 500
_COMPASS_SIGMA = 0.25  # rad per sample; what EKF3's 0.05 gauss per axis amounts to in heading

# EK3_SRCn_* values
GPS, COMPASS, EXTERNAL = 3, 1, 6


class Aiding(IntEnum):
    """EKF3's position and velocity aiding mode."""

    NONE = 0
    ABSOLUTE = 1


class AidedFilter:
    """Fuses measurements of the active source set (1 to 3) into the filter `gated` once aligned.

    armed: whether the vehicle is armed. `notify(severity, text)` sends a STATUSTEXT.
    """

    def __init__(self, parameters: Parameters, notify: Callable[[int, str], None]) -> None:
        self.gated = GatedFilter(parameters)
        self._parameters = parameters
        self._notify = notify
        self.origin: Location | None = None
        self.aiding = Aiding.NONE
        self.source_set = 1
        self.armed = False
        self._last_known_ne = (0.0, 0.0)
        self.aligned = False
        self._last_position_source = self._last_yaw_source = -1

    def set_origin(self, origin: Location) -> bool:
        """Set the origin; False, without a message, if there is one already (as in EKF3)."""
        if self.origin is not None:
            return False
        self.origin = origin
        self._tell(INFO, "origin set")
        return True

    def force_position(self, north_m: float, east_m: float, sigma_m: float) -> bool:
        """MAV_CMD_EXTERNAL_POSITION_ESTIMATE: reset the position; False if aided within 1 s."""
        if self.gated.now_ms - self.gated.clock.position_pass <= 1000 or self.origin is None:
            return False
        self.gated.reset_position(north_m, east_m, sigma_m**2)
        return True

    def fuse(self, measurement: Measurement) -> None:
        """Fuse one measurement if the active source set uses its source."""
        if isinstance(measurement, Baro):
            self._fuse_baro(measurement.height)
        elif isinstance(measurement, Compass):
            if self.source("YAW") == COMPASS:
                self.gated.fuse_yaw(measurement.yaw, _COMPASS_SIGMA)
        elif isinstance(measurement, GpsData):
            self._use_gps(measurement)
        elif isinstance(measurement, ExternalPosition):
            self._use_external(measurement)
        else:
            self._use_external_velocity(measurement)

    def _tell(self, severity: int, text: str) -> None:
        for lane in (0, 1):
            self._notify(severity, f"EKF3 IMU{lane} {text}")

    # --- sources and aiding ------------------------------------------------------------------

    def source(self, what: str) -> int:
        """EK3_SRCn_<what> of the active set."""
        return int(self._parameters[f"EK3_SRC{self.source_set}_{what}"])

    def check_sources(self) -> None:
        """After a change of the source set, its next position and yaw reset the filter."""
        position, yaw = self.source("POSXY"), self.source("YAW")
        if position != self._last_position_source:
            self.gated.source_reset = self._last_position_source >= 0 and position != 0
            self._last_position_source = position
        if yaw != self._last_yaw_source:
            self.gated.yaw_reset = self._last_yaw_source >= 0
            self._last_yaw_source = yaw

    def check_gps(self, gps: GpsData) -> None:
        """EKF3's receiver checks of a new fix: sets `gated.gps_fix_good`, and a missing origin."""
        now = self.gated.now_ms
        if not gps.good or now - self.gated.clock.gps_received > 1000:
            self.gated.clock.gps_bad = now
        self.gated.clock.gps_received = now
        self.gated.gps_fix_good = now - self.gated.clock.gps_bad >= _GPS_GOOD_MS
        if self.gated.gps_fix_good and self.origin is None:
            height = -float(self.gated.state[nav.P + 2])
            self.set_origin(Location(gps.latitude_deg, gps.longitude_deg, gps.altitude_m - height))

    def _start_aiding(self, source: str) -> None:
        self.aiding = Aiding.ABSOLUTE
        self.gated.position_timeout = self.gated.velocity_timeout = False
        self.gated.clock.position_pass = self.gated.clock.velocity_pass = self.gated.now_ms
        self._tell(INFO, f"is using {source}")

    def update_aiding(self) -> None:
        """End aiding by sources that have timed out. Called after every step."""
        if self.aiding is not Aiding.ABSOLUTE:
            return
        now, clock = self.gated.now_ms, self.gated.clock
        position_used = now - clock.position_pass <= _POSITION_LOST_NO_VELOCITY_MS
        velocity_used = now - clock.velocity_pass <= _POSITION_LOST_NO_VELOCITY_MS
        self.gated.velocity_aiding = position_used or velocity_used
        silent = now - max(clock.position_pass, clock.velocity_pass)
        if silent > _ATTITUDE_LOST_MS:
            self._stop_aiding()
        elif not position_used:
            limit = (
                _POSITION_LOST_WITH_VELOCITY_MS
                if self.gated.velocity_aiding
                else _POSITION_LOST_NO_VELOCITY_MS
            )
            if now - clock.position_pass > limit:
                self.gated.position_timeout = True
                self.gated.velocity_timeout = not velocity_used

    def _stop_aiding(self) -> None:
        self.aiding = Aiding.NONE
        self.gated.position_timeout = self.gated.velocity_timeout = True
        self._last_known_ne = (float(self.gated.state[nav.P]), float(self.gated.state[nav.P + 1]))
        self.gated.state[nav.V : nav.V + 2] = 0.0
        nav.reset_error(self.gated.cov, 3, 2, self._parameters["EK3_VELNE_M_NSE"] ** 2)
        self.gated.ratios.position = self.gated.ratios.velocity = 0.0
        self._tell(WARNING, "stopped aiding")

    # --- fusion ------------------------------------------------------------------------------

    def _use_gps(self, gps: GpsData) -> None:
        self.gated.update_innovation_status()
        if self.source("YAW") == 2 and gps.yaw_rad is not None:
            self.gated.fuse_yaw(gps.yaw_rad, radians(10.0))
        if self.source("POSXY") != GPS or self.origin is None:
            return
        position = north_east(self.origin, gps.latitude_deg, gps.longitude_deg)
        sigma = max(gps.horizontal_accuracy, self._parameters["EK3_POSNE_M_NSE"])
        horizontal = gps.horizontal_velocity if self.source("VELXY") == GPS else None
        vertical = gps.vertical_velocity if self.source("VELZ") == GPS else None
        if self.aiding is Aiding.NONE:
            if not (self.gated.gps_fix_good and self.aligned):
                return
            self._start_aiding("GPS")
            self.gated.reset_position(*position, sigma**2)
            self.gated.reset_velocity(horizontal or (0.0, 0.0), 0.5**2 if horizontal else 25.0)
            return
        if self.gated.source_reset:
            self.gated.reset_position(*position, sigma**2)
        speed = max(gps.speed_accuracy, self._parameters["EK3_VELNE_M_NSE"])
        self.gated.fuse_position(position, sigma, horizontal)
        if horizontal is not None:
            self.gated.fuse_velocity(
                horizontal, vertical, speed, self._parameters["EK3_VELNE_M_NSE"]
            )
        elif vertical is not None:
            nav.fuse(
                self.gated.state, self.gated.cov, 5, vertical - self.gated.state[nav.V + 2], 0.5**2
            )
        if self.source("POSZ") == GPS:
            self.gated.fuse_height(gps.altitude_m - self.origin.altitude_m, 1.5)

    def _use_external(self, fix: ExternalPosition) -> None:
        if self.source("YAW") == EXTERNAL and fix.yaw_rad is not None:
            if self.gated.yaw_reset:
                self.gated.rotate_to(fix.yaw_rad, fix.yaw_sigma)
            else:
                self.gated.fuse_yaw(fix.yaw_rad, fix.yaw_sigma)
        if self.source("POSXY") != EXTERNAL:
            return
        north, east, down = fix.position
        if self.aiding is Aiding.NONE:
            if not self.aligned:
                return
            self._start_aiding("external nav data")
            self._tell(INFO, f"initial pos NED = {north:3.1f},{east:3.1f},{down:3.1f} (m)")
            self.gated.reset_position(north, east, fix.sigma**2)
            self.gated.reset_velocity((0.0, 0.0), 25.0)
            return
        if fix.reset or self.gated.source_reset:
            self.gated.reset_position(north, east, None)
            if self.source("POSZ") == EXTERNAL:
                self.gated.state[nav.P + 2] = down
        self.gated.fuse_position((north, east), fix.sigma, None)
        if self.source("POSZ") == EXTERNAL:
            self.gated.fuse_height(-down, max(fix.sigma, 0.1))

    def _use_external_velocity(self, observed: ExternalVelocity) -> None:
        if self.source("VELXY") != EXTERNAL or self.aiding is Aiding.NONE:
            return
        vertical = observed.velocity[2] if self.source("VELZ") == EXTERNAL else None
        if observed.is_delta:
            self.gated.clock.position_delta = self.gated.now_ms
        self.gated.fuse_velocity(observed.velocity[:2], vertical, observed.sigma, observed.sigma)

    def _fuse_baro(self, height: float) -> None:
        source = self.source("POSZ")
        external_fresh = (
            source == EXTERNAL
            and self.gated.now_ms - self.gated.clock.external_received < _HEIGHT_FRESH_MS
        )
        gps_fresh = (
            source == GPS
            and self.gated.now_ms - self.gated.clock.gps_received < _HEIGHT_FRESH_MS
            and self.aiding is Aiding.ABSOLUTE
        )
        if not (external_fresh or gps_fresh):
            self.gated.fuse_height(height, self._parameters["EK3_ALT_M_NSE"])
        if self.aiding is Aiding.NONE:
            # As EKF3: hold position with a synthetic measurement, to keep the tilt bounded.
            sigma = self._parameters["EK3_NOAID_M_NSE"] if self.armed else 0.5
            for i in range(2):
                residual = self._last_known_ne[i] - self.gated.state[nav.P + i]
                nav.fuse(self.gated.state, self.gated.cov, 6 + i, residual, sigma**2)
