"""Sensor source selection of the EKF, and start and end of aiding, as in EKF3 4.7.

Without aiding for 7 s (10 s with velocity) the position flag ends; after 15 s aiding ends. A jump
is accepted at once only if it is announced.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from math import radians

from sitl.embedded.ekf import navigation as nav
from sitl.embedded.ekf.gated_filter import GatedFilter
from sitl.embedded.ekf.measurements import (
    Baro,
    Compass,
    ExternalPosition,
    ExternalVelocity,
    GpsData,
    Measurement,
)
from sitl.embedded.parameters import Parameters
from sitl.embedded.severity import INFO, WARNING
from sitl.geodesy import Location, north_east

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
