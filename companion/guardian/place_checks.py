"""Where vision says the aircraft is, against the barometer, GNSS, and where it was before."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from companion.guardian.config import GuardianConfig
from companion.guardian.findings import Reading
from companion.guardian.place import LocalPlace
from companion.guardian.step import STEP_M, Step
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.messages import VehicleState, VisionFix

_FORGET_S = 120.0  # the barometer's drift against vision: its zero follows with this time
_MEDIAN_OF = 15
_BARO_FRESH_NS = 1_000_000_000
_FIX_FRESH_NS = 500_000_000
_SIGMAS = 4.0
_GNSS_FLOOR_M = 1.0
_GNSS_SIGMA_M = 2.5  # where the receiver does not say
_GNSS_AGE_S = 0.2  # of a report when it comes, beyond what its four sigmas cover
_DRIFT_MPS2 = 0.2  # what dead reckoning may be wrong by, as an acceleration
_SPEED_MPS = 1.0  # and of its speed


class HeightCheck:
    """Vision's height against the barometer's, both since they were first seen together."""

    def __init__(self, config: GuardianConfig) -> None:
        self._limit_m = config.height_m
        self._zero: float | None = None
        self._last_ns = 0
        self._differences: deque[float] = deque(maxlen=_MEDIAN_OF)

    def add(self, fix: VisionFix, state: VehicleState) -> Reading:
        """One fix, and the state at about its time."""
        altitude = state.pressure_altitude_m
        if altitude is None or abs(fix.time_ns - state.pressure_time_ns) > _BARO_FRESH_NS:
            return Reading(None)
        difference = fix.height_m - altitude
        self._differences.append(difference)
        median = float(np.median(self._differences))
        if self._zero is None:
            if len(self._differences) == _MEDIAN_OF:
                self._zero, self._last_ns = median, fix.time_ns
            return Reading(None)
        dt = min(max((fix.time_ns - self._last_ns) * 1e-9, 0.0), 1.0)
        self._last_ns = fix.time_ns
        apart = median - self._zero
        sigma = math.sqrt(float(fix.position_covariance_ned[2, 2]))
        bad = abs(apart) > self._limit_m + _SIGMAS * sigma
        if not bad:
            self._zero += apart * dt / _FORGET_S
        return Reading(bad, abs(apart))


class GnssCheck:
    """GNSS against vision while GNSS is there, whatever mode; neither is said to be right."""

    def __init__(self, config: GuardianConfig) -> None:
        self._cap_m = config.gnss_accuracy_cap_m

    def read(
        self, fix: VisionFix, state: VehicleState, protection_m: float, now_ns: int
    ) -> Reading:
        """The newest fix against the newest report."""
        latitude, longitude = state.gps_latitude_deg, state.gps_longitude_deg
        if latitude is None or longitude is None or not gnss_healthy(state, now_ns):
            return Reading(None)
        if abs(state.gps_time_ns - fix.time_ns) > _FIX_FRESH_NS:
            return Reading(None)
        place = LocalPlace()
        place.ned(fix)
        north, east = place.north_east(latitude, longitude)
        accuracy = _GNSS_SIGMA_M if state.gps_h_accuracy_m is None else state.gps_h_accuracy_m
        accuracy = min(max(accuracy, _GNSS_FLOOR_M), self._cap_m)
        v_north, v_east, _ = state.local_velocity_ned or (0.0, 0.0, 0.0)
        later_s = (fix.time_ns - state.gps_time_ns) * 1e-9
        apart = math.hypot(north + v_north * later_s, east + v_east * later_s)
        limit = _SIGMAS * accuracy + protection_m + _GNSS_AGE_S * math.hypot(v_north, v_east)
        return Reading(apart > limit, apart)


@dataclass(frozen=True)
class _Passed:
    fix: VisionFix
    velocity_ned: tuple[float, float, float]


class JumpCheck:
    """A position that is farther from the last than any flight explains is held for a while."""

    def __init__(self, config: GuardianConfig) -> None:
        self._config = config
        self._place = LocalPlace()
        self._passed: _Passed | None = None
        self._held: VisionFix | None = None
        self._held_since_ns = 0
        self.distance_m = 0.0
        self.step: Step | None = None
        """Of the newest fix: it passed, but nothing explains where it is."""

    def admit(self, fix: VisionFix, state: VehicleState, *, agrees: bool) -> bool:
        """Whether the fix may pass. agrees: vision moves as the IMU does, or nobody knows."""
        jump_m = 0.0
        self.step = step = None
        if self._passed is not None:
            step, allowed_m = self._leap(self._passed, fix)
            jump_m = math.hypot(*step.offset_m) - allowed_m
        limit_m = self._config.jump_m if fix.reset else self._config.untold_jump_m
        if jump_m <= limit_m:
            if step is not None and jump_m > 0.0 and not fix.reset:
                self.step = step if math.hypot(*step.offset_m) >= STEP_M else None
            self._pass(fix, state)
            return True
        self.distance_m = jump_m
        continues = self._held is not None and self._near(self._held, fix)
        if not continues:
            self._held_since_ns = fix.time_ns
        self._held = fix
        held_s = (fix.time_ns - self._held_since_ns) * 1e-9
        if agrees and held_s >= self._config.jump_hold_s:
            self._pass(fix, state)
            return True
        return False

    def _pass(self, fix: VisionFix, state: VehicleState) -> None:
        velocity = state.local_velocity_ned or (0.0, 0.0, 0.0)
        self._passed, self._held = _Passed(fix, velocity), None

    def _leap(self, last: _Passed, fix: VisionFix) -> tuple[Step, float]:
        """How far the fix is from where the last one leads, and how far it may be, metres."""
        dt = max((fix.time_ns - last.fix.time_ns) * 1e-9, 0.0)
        there, here = self._place.ned(last.fix), self._place.ned(fix)
        v_north, v_east, _ = last.velocity_ned
        off = (here[0] - there[0] - v_north * dt, here[1] - there[1] - v_east * dt)
        sigma = math.hypot(_sigma(last.fix), _sigma(fix))
        # After a gap the way may have turned. A fix that is held is no gap: its jump would pass by
        # waiting for a second (5 degrees of a turned frame, 10 m at 120 m from home).
        gap = dt > 1.0 and self._held is None
        reach = math.hypot(v_north, v_east) * dt if gap else 0.0
        allowed = _SIGMAS * sigma + _SPEED_MPS * dt + 0.5 * _DRIFT_MPS2 * dt * dt + reach
        return Step(fix.time_ns, off, (v_north, v_east)), allowed

    def _near(self, held: VisionFix, fix: VisionFix) -> bool:
        """Whether the fix follows the held one as an aircraft flies."""
        dt = (fix.time_ns - held.time_ns) * 1e-9
        there, here = self._place.ned(held), self._place.ned(fix)
        apart = math.hypot(here[0] - there[0], here[1] - there[1])
        return apart <= self._config.jump_m + 30.0 * max(dt, 0.0) + _SIGMAS * _sigma(fix)


def _sigma(fix: VisionFix) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(fix.position_covariance_ned[:2, :2])[-1]))
