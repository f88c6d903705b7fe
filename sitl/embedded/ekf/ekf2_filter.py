"""GNSS, external vision and the auxiliary global position, fused together as PX4's EKF2 does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from sitl.embedded.ekf import navigation as nav
from sitl.embedded.ekf.aided_filter import AidedFilter, Aiding
from sitl.embedded.ekf.measurements import (
    Baro,
    Compass,
    ExternalPosition,
    ExternalVelocity,
    GpsData,
    Measurement,
)
from sitl.embedded.parameters import Parameters
from sitl.geodesy import north_east

Source = Literal["gnss", "vision", "auxiliary"]
Place = tuple[float, float]

_NEVER = -1_000_000
_RESET_MS = 5000  # out of its gate for so long, a source may reset the position
_VISION_FAILING_MS = 1000
_VISION_RESETS = 5
_SILENT_MS: dict[Source, int] = {"gnss": 5000, "vision": 400, "auxiliary": 5000}
_BIAS_GAIN = 0.05  # of vision's offset from GNSS; EKF2 has a filter of its own for it
_COMPASS_SIGMA = 0.25
_HORIZONTAL, _VELOCITY = 1, 4  # bits of EKF2_GPS_CTRL and EKF2_EV_CTRL


@dataclass
class _Aid:
    """State of one source of horizontal position. active: it aids the filter. fused, received:
    times of the last fused and the last received measurement, ms since boot.
    """

    active: bool = False
    fused: int = _NEVER
    received: int = _NEVER


class Ekf2Filter(AidedFilter):
    """PX4's fusion: fuses every source that its parameter enables; no source sets."""

    def __init__(self, parameters: Parameters, notify: Callable[[int, str], None]) -> None:
        super().__init__(parameters, notify)
        self._aids: dict[Source, _Aid] = {name: _Aid() for name in _SILENT_MS}
        self._gnss_fault = False
        self._bias = (0.0, 0.0)  # of vision's position, less the state's
        self._resets_left = _VISION_RESETS

    def fuse(self, measurement: Measurement) -> None:
        """See `AidedFilter.fuse`."""
        if isinstance(measurement, Baro):
            self._fuse_baro(measurement.height)
        elif isinstance(measurement, Compass):
            self.gated.fuse_yaw(measurement.yaw, _COMPASS_SIGMA)
        elif isinstance(measurement, GpsData):
            self._use_gps(measurement)
        elif isinstance(measurement, ExternalVelocity):
            if self.aiding is Aiding.ABSOLUTE and self._on("EKF2_EV_CTRL", _VELOCITY):
                v, sigma = measurement.velocity, measurement.sigma
                self.gated.fuse_velocity(v[:2], v[2], sigma, sigma)
        elif measurement.is_global:
            self._use_auxiliary(measurement)
        else:
            self._use_external(measurement)

    def source(self, what: str) -> int:
        """Always 0, because EKF2 has no source sets."""
        return 0

    def check_sources(self) -> None:
        """Does nothing, because EKF2 has no source sets."""

    def update_aiding(self) -> None:
        """End sources that are silent. End aiding if nothing was fused for EKF2_NOAID_TOUT."""
        now, clock = self.gated.now_ms, self.gated.clock
        for name, aid in self._aids.items():
            aid.active = aid.active and now - aid.received <= _SILENT_MS[name]
        last = max(clock.position_pass, clock.velocity_pass)
        limit_ms = self._parameters["EKF2_NOAID_TOUT"] / 1000.0
        if self.aiding is Aiding.ABSOLUTE and now - last > limit_ms:
            self._stop_aiding()

    def _tell(self, severity: int, text: str) -> None:
        """Does nothing, because EKF2 sends no texts."""

    # --- sources -----------------------------------------------------------------------------

    def _use_gps(self, gps: GpsData) -> None:
        aid, now = self._aids["gnss"], self.gated.now_ms
        if not (self._on("EKF2_GPS_CTRL", _HORIZONTAL) and self.gated.gps_fix_good):
            return
        if self.origin is None:
            return
        aid.received = now
        place = north_east(self.origin, gps.latitude_deg, gps.longitude_deg)
        sigma = max(gps.horizontal_accuracy, self._parameters["EKF2_GPS_P_NOISE"])
        fused = self._fuse_position("gnss", place, sigma, "EKF2_GPS_P_GATE")
        due = now - aid.fused > _RESET_MS if aid.active else not fused
        dead_reckoning = self._parameters["EKF2_GPS_MODE"] == 1 and self._has_velocity
        if due and not (self._gnss_fault or self._others("gnss") or dead_reckoning):
            self._reset("gnss", place, sigma)
            fused = True
        elif due and aid.active:
            aid.active, self._gnss_fault = False, True
        if fused:
            aid.active, self._gnss_fault = True, False
        velocity = gps.horizontal_velocity
        if aid.active and velocity is not None and self._on("EKF2_GPS_CTRL", _VELOCITY):
            speed = max(gps.speed_accuracy, 0.3)
            self.gated.fuse_velocity(velocity, gps.vertical_velocity, speed, speed)

    def _use_external(self, fix: ExternalPosition) -> None:
        """Use a position of external vision. While GNSS aids, only changes of the position count:
        an estimated bias absorbs its constant offset from GNSS. The bias stays after GNSS has
        ended.
        """
        aid, now = self._aids["vision"], self.gated.now_ms
        if not (self._on("EKF2_EV_CTRL", _HORIZONTAL) and self.origin is not None):
            return
        aid.received = now
        measured, gnss = fix.position[:2], self._aids["gnss"].active
        unbiased = (measured[0] - self._bias[0], measured[1] - self._bias[1])
        if not aid.active:
            self._resets_left = _VISION_RESETS
            self._bias = self._difference(measured) if gnss else (0.0, 0.0)
            self._start("vision", measured, fix.sigma, reset=not gnss)
        elif fix.reset and gnss:
            self._bias, aid.fused = self._difference(measured), now
        elif fix.reset:
            self._reset("vision", unbiased, fix.sigma)
        elif not self._fuse_position("vision", unbiased, fix.sigma, "EKF2_EVP_GATE"):
            self._fail_vision(measured, unbiased, fix.sigma)
        elif gnss:
            n, e = self._difference(unbiased)
            self._bias = (self._bias[0] + _BIAS_GAIN * n, self._bias[1] + _BIAS_GAIN * e)

    def _fail_vision(self, measured: Place, unbiased: Place, sigma: float) -> None:
        aid = self._aids["vision"]
        if self.gated.now_ms - aid.fused <= _VISION_FAILING_MS:
            return
        if self._resets_left == 0:
            aid.active = False
            return
        self._resets_left -= 1
        if self._aids["gnss"].active:
            self._bias, aid.fused = self._difference(measured), self.gated.now_ms
        else:
            self._reset("vision", unbiased, sigma)

    def _use_auxiliary(self, fix: ExternalPosition) -> None:
        aid, now = self._aids["auxiliary"], self.gated.now_ms
        if not self._on("EKF2_AGP0_CTRL", _HORIZONTAL):
            return
        aid.received = now
        place = fix.position[:2]
        fused = self._fuse_position("auxiliary", place, fix.sigma, "EKF2_AGP0_GATE")
        due = now - aid.fused > _RESET_MS if aid.active else not fused
        free = not self._others("auxiliary")
        if self._parameters["EKF2_AGP0_MODE"] == 1:
            free = free and not self._has_velocity
        if due and free:
            self._reset("auxiliary", place, fix.sigma)
        aid.active = fused or (free if due else aid.active)

    # --- helpers -----------------------------------------------------------------------------

    def _on(self, name: str, bit: int) -> bool:
        return self.aligned and bool(int(self._parameters[name]) & bit)

    def _others(self, source: Source) -> bool:
        return any(aid.active for name, aid in self._aids.items() if name != source)

    @property
    def _has_velocity(self) -> bool:
        return self.gated.now_ms - self.gated.clock.velocity_pass < _RESET_MS

    def _difference(self, place: Place) -> Place:
        n, e = (place[i] - float(self.gated.state[nav.P + i]) for i in range(2))
        return n, e

    def _start(self, source: Source, place: Place, sigma: float, *, reset: bool) -> None:
        aid = self._aids[source]
        aid.active, aid.fused = True, self.gated.now_ms
        if reset:
            self._reset(source, place, sigma)

    def _reset(self, source: Source, place: Place, sigma: float) -> None:
        self._aids[source].fused = self.gated.now_ms
        self.gated.reset_position(*place, sigma**2)
        self.gated.ratios.position = 0.0
        if self.aiding is Aiding.NONE:
            self.gated.reset_velocity((0.0, 0.0), 25.0)
        self._aid()

    def _aid(self) -> None:
        self.aiding = Aiding.ABSOLUTE
        self.gated.position_timeout = self.gated.velocity_timeout = False

    def _fuse_position(self, source: Source, place: Place, sigma: float, gate: str) -> bool:
        """Fuse a position if both axes are inside the gate; returns whether it was fused. gate:
        name of the gate's parameter.
        """
        gated = self.gated
        limit = max(self._parameters[gate], 1.0) ** 2
        innovation = self._difference(place)
        gated.ratios.position = max(
            innovation[i] ** 2 / (limit * (gated.cov[6 + i, 6 + i] + sigma**2)) for i in range(2)
        )
        if self.aiding is Aiding.NONE or gated.ratios.position >= 1.0:
            return False
        for i in range(2):
            nav.fuse(gated.state, gated.cov, 6 + i, place[i] - gated.state[nav.P + i], sigma**2)
        gated.clock.position_pass = self._aids[source].fused = gated.now_ms
        return True
