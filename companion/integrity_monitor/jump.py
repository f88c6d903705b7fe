"""Holds a position that is farther from the last one than the aircraft can have flown, or turned.

A map frame turned by 5 degrees about home puts a hover at 120 m 10 m aside. From then on the
position moves as the IMU does, so its motion shows no fault. The turn itself does, against gyros
and autopilot.
"""

from __future__ import annotations

import math
import statistics
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass

from companion.integrity_monitor.position_checks import LocalPlace
from companion.integrity_monitor.step import UNREPORTED_JUMP_M, PositionStep
from localizer.sensors.error_model import SENSORS
from mavlink_bridge.messages import Attitude, VehicleState, VisionFix
from mavlink_bridge.quaternion import wrap_pi
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_SPAN_NS = 1_000_000_000  # over which the heading is the median
_LEAST = 3
_OFF_RAD = math.radians(SENSORS.heading_step_deg)
_KEPT_HEADINGS = 64


@dataclass(frozen=True)
class HeadingChange:
    """Vision's heading of a fix minus that of the gyros and of the autopilot, rad; its sigma."""

    time_ns: int
    against_gyros: float
    against_autopilot: float
    sigma: float


def heading_change(fix: VisionFix, attitude: Attitude | None) -> HeadingChange | None:
    """The heading differences of a fix; None if one of the headings is unknown. attitude: the
    autopilot's at the fix's time.
    """
    yaw_rad = fix.yaw_rad
    if attitude is None or yaw_rad is None:
        return None
    return HeadingChange(
        fix.time_ns,
        wrap_pi(yaw_rad - attitude.gyro_heading_rad),
        wrap_pi(yaw_rad - attitude.yaw_rad),
        fix.attitude_sigma_rad,
    )


class HeadingHistory:
    """Heading differences of the newest 64 fixes in time order."""

    def __init__(self) -> None:
        self._turns: deque[HeadingChange] = deque(maxlen=_KEPT_HEADINGS)

    def add(self, turn: HeadingChange | None) -> None:
        """Add a fix's heading difference; None is ignored."""
        if turn is not None:
            self._turns.append(turn)

    def rotation_from_median(self, turn: HeadingChange) -> float:
        """Size of a fix's rotation from the median of the newest second, rad; 0 with too few
        headings.

        The gyros' heading has errors after lost ATTITUDE messages, and the autopilot's may step; a
        rotation counts only if both show it.
        """
        newest = self._newest()
        if len(newest) < _LEAST:
            return 0.0
        return min(
            abs(_median([wrap_pi(turn.against_gyros - one.against_gyros) for one in newest])),
            abs(
                _median([wrap_pi(turn.against_autopilot - one.against_autopilot) for one in newest])
            ),
        )

    def is_rotated(self, turn: HeadingChange) -> bool:
        """Whether a fix's heading is rotated by more than noise and gyro drift explain."""
        if not self._turns:
            return False
        newest = self._turns[-1]
        # Errors of vision are alike within a second: a median has the sigma of one.
        noise = _SIGMAS * math.hypot(newest.sigma, turn.sigma)
        drift = VEHICLE_SENSORS.gyro_drift_radps * (turn.time_ns - newest.time_ns) * 1e-9
        return self.rotation_from_median(turn) > _OFF_RAD + noise + drift

    def _newest(self) -> list[HeadingChange]:
        """Headings of the last second, and at least the newest three."""
        turns = list(self._turns)
        since_ns = turns[-1].time_ns - _SPAN_NS if turns else 0
        within = sum(turn.time_ns > since_ns for turn in turns)
        return turns[-max(within, _LEAST) :]


def _median(angles: list[float]) -> float:
    """Median of angles (rad) near the first one, because angles wrap."""
    return wrap_pi(angles[0] + statistics.median(wrap_pi(a - angles[0]) for a in angles))


_JUMP_M = 10.0  # announced jumps above this are held
_HOLD_S = 5.0  # time that a jumped position must agree in motion
_SIGMAS = 4.0
_DRIFT_MPS2 = 0.2  # what a velocity carried on may be wrong by, as an acceleration
_SPEED_MPS = 1.0  # and of its speed
_FASTEST_MPS = 30.0
_GAP_S = 1.0
_RECKONS_S = 10.0  # afterwards an EKF without positions gives up: no evidence any more
_HEADING_S = 60.0  # for which the gyros know the heading, as the yaw guard has it
_TURNED_FIXES = 3  # in a row
_CALM_FIXES = 5  # to which it led in a row: after a gap it is off by 10 m/s and more
_KEPT = 600

Metres = tuple[float, float]


class EkfDisplacement:
    """Horizontal displacement by the EKF's velocity (LOCAL_POSITION_NED, 32)."""

    def __init__(self) -> None:
        self._way: deque[tuple[int, Metres, Metres]] = deque(maxlen=_KEPT)  # time, velocity, way

    def add(self, state: VehicleState) -> None:
        """Integrate the EKF's newest velocity (NED, m/s). A state without a velocity or with an old
        one is ignored; a gap in the timestamps restarts the integral.
        """
        if state.local_velocity_ned is None:
            return
        north, east, _ = state.local_velocity_ned
        way = (0.0, 0.0)
        if self._way:
            time_ns, before, at = self._way[-1]
            dt = (state.local_time_ns - time_ns) * 1e-9
            if -_GAP_S < dt <= 0.0:
                return
            if 0.0 < dt <= _GAP_S:
                half = 0.5 * dt
                way = (at[0] + half * (before[0] + north), at[1] + half * (before[1] + east))
            else:
                self._way.clear()
        self._way.append((state.local_time_ns, (north, east), way))

    def displacement(self, from_ns: int, to_ns: int) -> Metres | None:
        """North and east displacement between two times, metres; None where unknown."""
        a, b = self._at(from_ns), self._at(to_ns)
        return None if a is None or b is None else (b[0] - a[0], b[1] - a[1])

    def _at(self, time_ns: int) -> Metres | None:
        """Integral (north, east), m: interpolated, or extrapolated by up to a second; or None."""
        if not self._way:
            return None
        k = min(bisect_left(self._way, time_ns, key=lambda one: one[0]), len(self._way) - 1)
        known_ns, (north, east), (way_north, way_east) = self._way[k]
        dt = (time_ns - known_ns) * 1e-9
        if abs(dt) > _GAP_S:
            return None
        if dt < 0.0 and k > 0:  # the mean velocity of the interval's end
            before_ns, before, _ = self._way[k - 1]
            share = 0.5 * (known_ns - time_ns) / (known_ns - before_ns)
            north, east = north + share * (before[0] - north), east + share * (before[1] - east)
        return way_north + north * dt, way_east + east * dt


@dataclass(frozen=True)
class _Passed:
    fix: VisionFix
    velocity: Metres


class _Held:
    """The series of held fixes, each consistent with the one before."""

    def __init__(self, first: VisionFix) -> None:
        self.first = self.newest = first
        self.contradicted = False
        """It moved as the EKF's velocity does not."""
        self.headings = HeadingHistory()
        self.turned = False
        """Its frame turned against that of the last ones that passed."""
        self._turned_in_a_row = 0

    @property
    def seconds(self) -> float:
        return (self.newest.time_ns - self.first.time_ns) * 1e-9

    def add_heading(self, turn: HeadingChange | None, *, is_turned: bool) -> None:
        """Add the newest fix's heading. is_turned: it is rotated against the accepted fixes."""
        self.headings.add(turn)
        if turn is not None:
            self._turned_in_a_row = self._turned_in_a_row + 1 if is_turned else 0
        self.turned = self.turned or self._turned_in_a_row >= _TURNED_FIXES


class JumpCheck:
    """Holds a position that is farther from the last one than flight explains, for some seconds.

    Meanwhile the last accepted position is propagated by the EKF's velocity, which held fixes do
    not affect. A fix near the propagated position passes at once. A position that moves unlike the
    IMU, or whose heading turned unlike gyros and autopilot, does not pass by waiting.
    """

    def __init__(self) -> None:
        self._place = LocalPlace()
        self._reckoning = EkfDisplacement()
        self._passed: _Passed | None = None
        self._held: _Held | None = None
        self._headings = HeadingHistory()  # of what passed
        self._predictions = 0  # passed fixes in a row that lay where the EKF's velocity led
        self.distance_m = 0.0
        self.step: PositionStep | None = None
        """Of the newest fix, if it passed: how far from where the one before led."""
        self.announced = False
        """Whether the newest fix says that the estimate jumped since the one that passed last."""
        self.jumped = False
        """Whether the newest fix is at another place than the one before: how it moves is judged
        again from here on.
        """

    def add_state(self, state: VehicleState) -> None:
        """Integrate the EKF's velocity; a few times a second, with or without fixes."""
        self._reckoning.add(state)

    def admit(
        self,
        fix: VisionFix,
        state: VehicleState,
        attitude: Attitude | None = None,
        *,
        agrees: bool,
    ) -> bool:
        """Whether the fix may pass; called once for each fix, in time order. Sets `step`,
        `announced`, `jumped` and, of a held fix, `distance_m`. attitude: the autopilot's at the
        fix's time; agrees: vision moves as the IMU does, or this is unknown.
        """
        self._reckoning.add(state)
        was_held = self._held
        passes = self._passes(fix, state, attitude, agrees=agrees)
        self.jumped = self._held is not was_held
        return passes

    def _passes(
        self, fix: VisionFix, state: VehicleState, attitude: Attitude | None, *, agrees: bool
    ) -> bool:
        self.step = None
        self.announced = self._passed is None or (fix.reset_count != self._passed.fix.reset_count)
        turn = heading_change(fix, attitude)
        is_turned = turn is not None and self._is_turned(turn)
        step = None if self._passed is None else self._step_from(self._passed, fix)
        jump_m = 0.0 if step is None else math.hypot(*step.offset_m) - step.allowed_m
        if step is not None and is_turned:
            jump_m += step.growth_m  # nor does time explain it
        explained = self.announced and not is_turned
        if jump_m <= (_JUMP_M if explained else UNREPORTED_JUMP_M):
            self.step = step
            is_predicted = step is not None and step.is_predicted
            self._predictions = self._predictions + 1 if is_predicted else 0
            self._pass(fix, state)
            self._headings.add(turn)
            return True
        self.distance_m = jump_m
        held = self._hold(fix)
        held.add_heading(turn, is_turned=is_turned)
        speaks_against = held.contradicted or (held.turned and is_turned)
        if agrees and not speaks_against and held.seconds >= _HOLD_S:
            self._predictions = 0
            self._pass(fix, state)
            self._headings = held.headings
            return True
        return False

    def _pass(self, fix: VisionFix, state: VehicleState) -> None:
        north, east, _ = state.local_velocity_ned or (0.0, 0.0, 0.0)
        self._passed, self._held = _Passed(fix, (north, east)), None

    def _is_turned(self, turn: HeadingChange) -> bool:
        """Whether a fix's heading is rotated against the last accepted ones.

        The gyros' drift grows with time. Therefore, after a rotation was detected, a fix belongs to
        the frame of reference (accepted or held) whose heading is nearer.
        """
        if self._passed is None or turn.time_ns - self._passed.fix.time_ns > _HEADING_S * 1e9:
            return False
        held = self._held
        if held is not None and held.turned:
            passed = self._headings.rotation_from_median(turn)
            return held.headings.rotation_from_median(turn) < passed
        return self._headings.is_rotated(turn)

    def _hold(self, fix: VisionFix) -> _Held:
        """Add the fix to the held series; if they are inconsistent, it starts a new series."""
        held = self._held
        if held is None or not self._follows(held.newest, fix):
            held = self._held = _Held(fix)
        held.newest = fix
        since_s = 0.0 if self._passed is None else _seconds(self._passed.fix, fix)
        held.contradicted = since_s <= _RECKONS_S and (
            held.contradicted or self._moves_otherwise(held, since_s)
        )
        return held

    def _moves_otherwise(self, held: _Held, since_s: float) -> bool:
        """Whether the held fixes move unlike the EKF's velocity. since_s: dead reckoning so far."""
        predicted = self._predicted(held.first, held.newest)
        if predicted is None:
            return False
        apart_m = math.hypot(*self._off(held.first, predicted, held.newest))
        return apart_m > _SIGMAS * math.hypot(
            _sigmas(held.first, held.newest), _drift_sigma_m(since_s)
        )

    def _step_from(self, last: _Passed, fix: VisionFix) -> PositionStep:
        """Offset of the fix from where the last accepted one leads, and its limit."""
        dt = max(_seconds(last.fix, fix), 0.0)
        sigma = _SIGMAS * _sigmas(last.fix, fix)
        # While another is held, to let the allowance grow would let it pass by waiting (5 degrees
        # of a turned frame, 10 m at 120 m from home: after 3.8 s), and hold the right one behind.
        predicted = self._predicted(last.fix, fix) if self._held is not None else None
        if predicted is not None:
            allowed = math.hypot(sigma, _SIGMAS * _drift_sigma_m(dt))
        else:
            predicted = (last.velocity[0] * dt, last.velocity[1] * dt)
            allowed = sigma + _SPEED_MPS * dt + 0.5 * _DRIFT_MPS2 * dt * dt
            if dt > _GAP_S and self._held is None:  # the way may have turned
                allowed += math.hypot(*predicted)
        off = self._off(last.fix, predicted, fix)
        return PositionStep(
            fix.time_ns, off, last.velocity, fix.horizontal_sigma_m, allowed, allowed - sigma, dt
        )

    def _predicted(self, last: VisionFix, fix: VisionFix) -> Metres | None:
        """Displacement by the EKF's velocity, m; None where its prediction failed before."""
        if self._predictions < _CALM_FIXES:
            return None
        return self._reckoning.displacement(last.time_ns, fix.time_ns)

    def _off(self, last: VisionFix, predicted: Metres, fix: VisionFix) -> Metres:
        """(north, east) offset of `fix` from `last` displaced by `predicted`, metres."""
        there, here = self._place.ned(last), self._place.ned(fix)
        return here[0] - there[0] - predicted[0], here[1] - there[1] - predicted[1]

    def _follows(self, held: VisionFix, fix: VisionFix) -> bool:
        """Whether an aircraft can fly from the held fix to this one, at up to 30 m/s."""
        apart_m = math.hypot(*self._off(held, (0.0, 0.0), fix))
        reach_m = _FASTEST_MPS * max(_seconds(held, fix), 0.0)
        return apart_m <= UNREPORTED_JUMP_M + reach_m + _SIGMAS * _sigmas(held, fix)


def _drift_sigma_m(dt: float) -> float:
    """One sigma of the EKF's displacement after dt seconds of dead reckoning, m."""
    known_s = min(dt, _RECKONS_S)
    return SENSORS.ekf_drift.sigma_m(known_s)


def _seconds(a: VisionFix, b: VisionFix) -> float:
    return (b.time_ns - a.time_ns) * 1e-9


def _sigmas(a: VisionFix, b: VisionFix) -> float:
    return math.hypot(a.horizontal_sigma_m, b.horizontal_sigma_m)
