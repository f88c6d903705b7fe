"""Converts vision fixes to messages that a flight controller fuses.

Timing. A fix is sent when its age reaches `delay_ms`, the value that ArduPilot is told
(VISO_DELAY_MS, GPSn_DELAY_MS), so the least latency it sees is exactly that. A fix that arrives
later is sent at once with its own exposure time, and the flight controller removes the jitter. PX4
maps the exposure time by TIMESYNC and needs no such value.

Between fixes, and for fixes older than the autopilot can fuse, the newest fix is propagated to
``now - delay_ms`` with its covariance grown. These messages never delay a fix. Time stamps never
decrease.

Yaw guard, because ArduPilot does not check yaw. Measured: a vision frame rotated by 5 deg causes 25
m of error without a warning; a yaw error of 30 deg is accepted with EK3_SRC1_YAW = 6. The EKF's own
yaw is no reference: it steps by up to 8 deg after take-off and drifts by 6 deg in hover on
ODOMETRY. So the first fixes must agree with the autopilot's yaw, and later ones must turn as the
gyros do. Agreement with the autopilot does not excuse a turn against the gyros: a frame rotated by
5 deg came within 3 deg of an EKF yaw that was 2 deg wrong.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter, deque
from typing import Any

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import InjectionConfig
from mavlink_bridge.injection.encode import (
    EncodedEstimate,
    EncodedMessage,
    HeldOutput,
    InjectionContext,
    MessageEncoder,
    vision_attitude,
    vision_position_delta,
)
from mavlink_bridge.injection.propagate import FixPropagator, propagated_protection
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.messages import Attitude, VisionFix
from mavlink_bridge.quaternion import wrap_pi
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_LIMIT_RAD = math.radians(3.5)  # against the autopilot's yaw, or its gyros since earlier fixes
_GROSS_RAD = math.radians(20.0)  # largest difference in any case
_MEMORY_S = 60.0  # time for which the gyros are used
_MINIMUM_SAMPLES = 5  # fixes compared: the majority blocks, all release
_BASELINE_NS = 1_000_000_000
_RELEASE_SHARE = 0.7
_BLIND_AFTER = 20  # fixes in a row


class YawGuard:
    """Rejects fixes whose yaw changed wrongly, and blocks injection if most of the last ones did.

    It blocks if the majority of five fixes fail, because noise lets some fixes of a
    rotated frame pass. It releases after as many good fixes in a row, tested with a smaller limit.
    """

    def __init__(self) -> None:
        # (time, vision minus gyro heading, vision minus autopilot)
        self._accepted: deque[tuple[int, float, float]] = deque(maxlen=256)
        self._last: deque[bool] = deque(maxlen=_MINIMUM_SAMPLES)
        self._reset_count = 0  # of the fix before
        self.blocked = False
        self.difference_rad: float | None = None
        """The last fix's yaw minus the autopilot's; None while none could be compared."""
        self._unchecked_in_a_row = 0

    @property
    def refused_rad(self) -> float | None:
        """Yaw difference for which injection is blocked; None while it is not."""
        return self.difference_rad if self.blocked else None

    @property
    def blind(self) -> bool:
        """Whether the last 20 or more fixes had no yaw to compare."""
        return self._unchecked_in_a_row >= _BLIND_AFTER

    def reset(self) -> None:
        """Forget the history, because the autopilot rebooted and its yaw changed."""
        self._accepted.clear()
        self._last.clear()
        self.blocked = False

    def accepts(self, fix: VisionFix, autopilot: Attitude | None) -> bool:
        """Check one fix, in order of time; whether it may be sent. autopilot: its attitude at that
        time, None if unknown. A fix without both yaws passes unless the guard blocks.
        """
        time_ns, vision_yaw_rad = fix.time_ns, fix.yaw_rad
        reset = fix.reset_count != self._reset_count
        self._reset_count = fix.reset_count
        if autopilot is None or vision_yaw_rad is None:
            self._unchecked_in_a_row += 1
            return not self.blocked
        self._unchecked_in_a_row = 0
        self.difference_rad = difference = wrap_pi(vision_yaw_rad - autopilot.yaw_rad)
        to_gyros = wrap_pi(vision_yaw_rad - autopilot.gyro_heading_rad)
        good = self._agrees(time_ns, difference, to_gyros, reset)
        self._update_block(good)
        accept = good and not self.blocked
        if good and reset:
            self._accepted.clear()  # what follows is held against this fix, not against the past
        if accept:
            self._accepted.append((time_ns, to_gyros, difference))
        return accept

    def _update_block(self, good: bool) -> None:
        """Add a result; block or release by the last ones."""
        last = self._last
        last.append(good)
        if self.blocked:
            change = len(last) == last.maxlen and all(last)
        else:
            change = 2 * last.count(False) > _MINIMUM_SAMPLES
        if change:
            self.blocked = not self.blocked
            last.clear()

    def _agrees(self, time_ns: int, difference: float, to_gyros: float, reset: bool) -> bool:
        limit = _LIMIT_RAD * (_RELEASE_SHARE if self.blocked else 1.0)
        near = abs(difference) <= limit
        if abs(difference) > _GROSS_RAD or not self._accepted:
            return near
        newest_ns = self._accepted[-1][0]
        gap_s = (time_ns - newest_ns) * 1e-9
        if gap_s > _MEMORY_S:
            return near
        recent = [entry for entry in self._accepted if newest_ns - entry[0] <= _BASELINE_NS]
        turned = abs(statistics.median(wrap_pi(to_gyros - entry[1]) for entry in recent))
        if turned <= min(limit + VEHICLE_SENSORS.gyro_drift_radps * gap_s, _GROSS_RAD):
            return True
        # The gyro heading suffers where ATTITUDE was lost in a turn; the autopilot's yaw does not.
        against = abs(statistics.median(wrap_pi(difference - entry[2]) for entry in recent))
        return near and (reset or against <= limit)


_QUEUE = 32
_FUTURE_SLACK_NS = 20_000_000
_INTERVALS, _INTERVALS_KNOWN = 10, 3
_STALE_NS = 3_000_000_000
_DELTA_NS = 500_000_000  # between two fixes that give a velocity
_AGES = 50


class Latency:
    """Ages of the last 50 fixes at their arrival, from exposure, milliseconds."""

    def __init__(self) -> None:
        self._ages_ms: deque[float] = deque(maxlen=_AGES)

    def add(self, age_ms: float) -> None:
        """Add the age of a fix."""
        self._ages_ms.append(age_ms)

    @property
    def is_known(self) -> bool:
        """Whether there are 50 fixes."""
        return len(self._ages_ms) == _AGES

    @property
    def median_ms(self) -> float | None:
        """Median age; None before the first fix."""
        return statistics.median(self._ages_ms) if self._ages_ms else None

    @property
    def least_ms(self) -> float | None:
        """Age of the youngest fix; None before the first."""
        return min(self._ages_ms, default=None)


class _FixRate:
    """Interval at which fixes reach the age `delay_ms`, and whether the next one is overdue."""

    def __init__(self, overdue_intervals: float) -> None:
        self._overdue_intervals = overdue_intervals
        self._intervals_ns: deque[int] = deque(maxlen=_INTERVALS)
        self._taken_ns = 0

    def add(self, time_ns: int, last_ns: int | None, now_ns: int) -> None:
        """Add a fix of exposure time_ns, used at now_ns; last_ns: of the fix before, or None."""
        self._taken_ns = now_ns
        if last_ns is not None and time_ns - last_ns < _STALE_NS:
            self._intervals_ns.append(time_ns - last_ns)

    @property
    def next_ns(self) -> int | None:
        """When the next fix reaches its age, at the usual interval; None while unknown."""
        usual = self._usual_ns()
        return None if usual is None else self._taken_ns + round(usual)

    def is_overdue(self, now_ns: int) -> bool:
        """Whether the next fix is late by `overdue_intervals` of the usual interval."""
        usual = self._usual_ns()
        return usual is not None and now_ns - self._taken_ns > self._overdue_intervals * usual

    def _usual_ns(self) -> float | None:
        if len(self._intervals_ns) < _INTERVALS_KNOWN:
            return None
        return statistics.median(self._intervals_ns)


class WithheldMotion:
    """Makes VISION_POSITION_DELTA from odometry's fixes whose positions are not sent."""

    def __init__(self) -> None:
        self._before: VisionFix | None = None
        self._message: Any | None = None

    def add(self, fix: VisionFix, now_ns: int, context: InjectionContext) -> None:
        """Add a fix that has reached the age `delay_ms`, and whose position is not sent."""
        before, self._before = self._before, fix
        late = now_ns - fix.time_ns > int(context.profile.max_delay_ms * 1e6)
        if before is None or late or not context.profile.position_delta:
            return
        then, now = context.attitude_at(before.time_ns), context.attitude_at(fix.time_ns)
        if then is not None and now is not None and fix.time_ns - before.time_ns <= _DELTA_NS:
            self._message = vision_position_delta((before, then), (fix, now))

    def take_message(self) -> Any | None:
        """The message that is due, once; otherwise None."""
        message, self._message = self._message, None
        return message


class Injector:
    """Makes the messages of fixes at a steady rate; one thread calls `submit` and `step`."""

    def __init__(self, config: InjectionConfig, geoid_separation_m: float, utc: SteadyUtc) -> None:
        self._config = config
        self._encoder = MessageEncoder(config, geoid_separation_m, utc)
        self._delay_ns = int(config.delay_ms * 1e6)
        self._period_ns = int(1e9 / config.rate_hz)
        self._least_gap_ns = int(self._period_ns / 1.5)  # 30 Hz never passes 50 Hz
        self._propagator = FixPropagator(config.acceleration_sigma_mps2, config.sigma_floor_m)
        self.guard = YawGuard()
        self._waiting: deque[VisionFix] = deque(maxlen=_QUEUE)
        self.latency = Latency()
        self._fresh: VisionFix | None = None
        self.reset_counter = 0
        """The reset counter of the last message."""
        self._announced = 0
        self._sent_jumps = 0  # of the localizer and announced, as the last message had them
        self._newest_ns = 0
        self._last_slot_ns = 0
        self._last_stamp_ns = 0
        self._last_was_fill = False
        self.motion = WithheldMotion()
        self._pace = _FixRate(config.overdue_intervals)
        self._sent_fix_ns = 0
        self.reason: Alert | None = alert(AlertId.NO_FIX_YET)
        """Why nothing was sent last; None when it was."""
        self.counters: Counter[str] = Counter()

    def submit(self, fix: VisionFix, now_ns: int) -> None:
        """Queue a fix that arrived at now_ns. A fix that is late by 3 s, from the future or out of
        order is dropped.
        """
        unusable = self._unusable(fix, now_ns)
        if unusable is not None:
            self.counters[unusable] += 1
            return
        self._newest_ns = fix.time_ns
        self.latency.add((now_ns - fix.time_ns) * 1e-6)
        self.counters["fixes"] += 1
        if len(self._waiting) == _QUEUE:
            self.counters["fixes_overflowed"] += 1
        self._waiting.append(fix)

    def _unusable(self, fix: VisionFix, now_ns: int) -> str | None:
        """Why a fix is dropped at once (name of its counter), or None."""
        if fix.time_ns <= self._newest_ns:
            return "fixes_out_of_order"
        if fix.time_ns > now_ns + _FUTURE_SLACK_NS:
            return "fixes_from_future"
        return "fixes_stale" if now_ns - fix.time_ns > _STALE_NS else None

    def announce_jump(self) -> None:
        """Increment the reset counter with the next message, so that the EKF resets to it."""
        self._announced += 1

    def clear(self) -> None:
        """Drop the queued fixes, because nothing can be sent now; propagation keeps the last."""
        self._waiting.clear()
        self._fresh = None

    def step(self, now_ns: int, context: InjectionContext) -> EncodedMessage | None:
        """The message to send at now_ns (CLOCK_MONOTONIC), or None. Takes the fixes whose age has
        reached the delay, tests their yaw, and updates the counters. `reason`: the alert that
        explains why a due position was not sent, None if it was.
        """
        self._take_due(now_ns, context)
        outcome = self._next(now_ns, context)
        if outcome is None:
            return None
        self._last_slot_ns = now_ns
        if isinstance(outcome, HeldOutput):
            self.reason = outcome.reason
            self.counters[outcome.counter] += 1
            return None
        self.reason = None
        self._last_stamp_ns = outcome.estimate.position.time_ns
        self._last_was_fill = not outcome.estimate.fresh
        self.counters["sent_fresh" if outcome.estimate.fresh else "sent_propagated"] += 1
        return outcome

    def next_due_ns(self, now_ns: int) -> int:
        """When to call `step` next, CLOCK_MONOTONIC ns; at least 0.5 ms after now_ns."""
        due = [now_ns + self._period_ns]
        if self._waiting:
            due.append(self._waiting[0].time_ns + self._delay_ns)
        if self._propagator.fix is not None:
            due.append(self._fill_due_ns())
        if self._fresh is not None:
            due.append(self._earliest_ns())
        return max(min(due), now_ns + 500_000)

    # --- fixes come of age -----------------------------------------------------------------------

    def _take_due(self, now_ns: int, context: InjectionContext) -> None:
        while self._waiting and self._waiting[0].time_ns + self._delay_ns <= now_ns:
            fix = self._waiting.popleft()
            if not self.guard.accepts(fix, context.attitude_at(fix.time_ns)):
                self.counters["fixes_yaw_refused"] += 1
                continue
            uncertain = fix.by_odometry and fix.horizontal_sigma_m > self._config.max_sigma_m
            if fix.position_withheld or uncertain:
                self.motion.add(fix, now_ns, context)
            if fix.position_withheld:
                continue
            last = self._propagator.fix
            self._pace.add(fix.time_ns, None if last is None else last.time_ns, now_ns)
            self._propagator.update(fix)
            if self._fresh is not None:
                self.counters["fixes_superseded"] += 1
            self._fresh = fix

    # --- what to send ----------------------------------------------------------------------------

    def _earliest_ns(self) -> int:
        return self._last_slot_ns + self._least_gap_ns

    def _fill_due_ns(self) -> int:
        """When the next propagated message is due. It is sent so early that it does not delay the
        next fix, or not at all: the EKF fuses a late fix at its position of that time, which is
        wrong by the distance flown. If the next fix is late, the message waits once for half a
        period.
        """
        due = self._waiting[0].time_ns + self._delay_ns if self._waiting else self._pace.next_ns
        if due is None or due <= self._last_slot_ns:
            patience = 1.0 if self._last_was_fill else 1.5
            return self._last_slot_ns + int(self._period_ns * patience)
        between = min(self._last_slot_ns + self._period_ns, due - self._least_gap_ns)
        return between if between >= self._earliest_ns() else due + self._period_ns // 2

    def _next(self, now_ns: int, context: InjectionContext) -> EncodedMessage | HeldOutput | None:
        if self._propagator.fix is None and not self.guard.blocked:
            return None
        fill_due = now_ns >= self._fill_due_ns()
        if (refused := self.guard.refused_rad) is not None:
            self._fresh = None
            degrees = math.degrees(refused)
            reason = alert(AlertId.YAW_MISMATCH, degrees=degrees)
            return HeldOutput(reason, "withheld_yaw") if fill_due else None
        if self._fresh is not None and now_ns >= self._earliest_ns():
            fix, self._fresh = self._fresh, None
            too_old = now_ns - fix.time_ns > int(context.profile.max_delay_ms * 1e6)
            if not too_old and fix.time_ns > self._last_stamp_ns:
                return self._make(fix.time_ns, now_ns, context, fresh=True)
            fill_due = True
        if not fill_due:
            return None
        return self._make(now_ns - self._delay_ns, now_ns, context, fresh=False)

    def _make(
        self, time_ns: int, now_ns: int, context: InjectionContext, *, fresh: bool
    ) -> EncodedMessage | HeldOutput | None:
        fix = self._propagator.fix
        position = self._propagator.at(time_ns)
        if fix is None or position is None or time_ns <= self._last_stamp_ns:
            return None
        too_far = (time_ns - fix.time_ns) * 1e-9 > self._config.max_extrapolation_s
        if too_far or (not fresh and self._pace.is_overdue(now_ns)):
            return HeldOutput(alert(AlertId.NO_FRESH_FIX), "withheld_stale")
        sigma = position.horizontal_sigma_m
        if sigma > self._config.max_sigma_m:
            over = alert(AlertId.SIGMA_OVER_LIMIT, metres=sigma)
            return HeldOutput(over, "withheld_covariance")
        jumps = fix.reset_count + self._announced
        counter = (self.reset_counter + (jumps != self._sent_jumps)) % 256
        estimate = EncodedEstimate(
            position,
            vision_attitude(fix, time_ns, context),
            fix.attitude_sigma_rad,
            fix.quality,
            counter,
            fresh,
            velocity_is_new=fix.velocity_ned is not None and fix.time_ns != self._sent_fix_ns,
            protection_m=propagated_protection(fix, position),
        )
        outcome = self._encoder.make(estimate, now_ns, context)
        if isinstance(outcome, EncodedMessage):
            self.reset_counter, self._sent_jumps = counter, jumps
            self._sent_fix_ns = fix.time_ns
        return outcome
