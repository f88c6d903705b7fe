"""From vision fixes to the messages that a flight controller fuses.

Timing. A fix is sent when its age reaches `delay_ms`, the value that ArduPilot is told
(VISO_DELAY_MS, GPSn_DELAY_MS), so the least latency it sees is exactly that; a late fix goes out at
once with its own exposure time, and the jitter is removed by the flight controller. PX4 maps the
exposure time by TIMESYNC and needs no such value.
Between fixes, and for fixes older than it can fuse, the newest fix is propagated to ``now -
delay_ms`` with its covariance grown. Stamps never run back.
"""

from __future__ import annotations

import math
import statistics
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from mavlink_bridge import quaternion as quat
from mavlink_bridge.config import InjectionConfig, InjectionMessage
from mavlink_bridge.injection.encode import (
    Estimate,
    global_position_sensor,
    gps_input,
    odometry,
    vision_position_estimate,
)
from mavlink_bridge.injection.propagate import FixPropagator
from mavlink_bridge.injection.yaw_guard import YawGuard
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.messages import Attitude, Origin, VisionFix
from mavlink_bridge.vehicle.origin import ned_from_origin
from mavlink_bridge.vehicle.profile import CovarianceFormula, FirmwareProfile

NAN = math.nan
NO_FIX_YET = "no fix yet"
NO_FRESH_FIX = "no fresh fix"
_QUEUE = 32
_LATENCIES = 50
_FARTHEST_M = 100_000.0  # from the origin: farther, one of the two is wrong
_FUTURE_SLACK_NS = 20_000_000
_INTERVALS, _INTERVALS_KNOWN = 10, 3
_STALE_NS = 3_000_000_000


@dataclass(frozen=True)
class Withheld:
    """Why nothing is sent although it is time. counter: the name it is counted under."""

    reason: str
    counter: str


@dataclass(frozen=True)
class Injection:
    """One message to send, and the estimate it was made from."""

    message: Any
    estimate: Estimate


@dataclass(frozen=True)
class InjectionContext:
    """What the injector must know about the vehicle. now: the origin and profile of this moment."""

    origin: Origin | None
    profile: FirmwareProfile
    attitude_at: Callable[[int], Attitude | None]


class FixQueue:
    """Fixes on their way from any thread to the link's; the oldest go first when it is full.

    A jump that went with a dropped fix is told by the next.
    """

    def __init__(self, length: int) -> None:
        self._length = length
        self._fixes: deque[VisionFix] = deque()
        self._lock = threading.Lock()
        self.dropped = 0

    def put(self, fix: VisionFix) -> None:
        """Append; never blocks for long."""
        with self._lock:
            self._fixes.append(fix)
            if len(self._fixes) > self._length:
                self.dropped += 1
                if self._fixes.popleft().reset:
                    self._fixes[0] = replace(self._fixes[0], reset=True)

    def __len__(self) -> int:
        return len(self._fixes)

    def take(self) -> list[VisionFix]:
        """All that wait, oldest first."""
        if not self._fixes:
            return []
        with self._lock:
            fixes = list(self._fixes)
            self._fixes.clear()
        return fixes


class Injector:
    """Turns fixes into a steady stream of injections. One thread calls `submit` and `step`."""

    def __init__(self, config: InjectionConfig, geoid_separation_m: float, utc: SteadyUtc) -> None:
        self._config = config
        self._geoid_m = geoid_separation_m
        self._utc = utc
        self._delay_ns = int(config.delay_ms * 1e6)
        self._period_ns = int(1e9 / config.rate_hz)
        self._propagator = FixPropagator(config.acceleration_sigma_mps2, config.sigma_floor_m)
        self.guard = YawGuard(config.yaw_guard)
        self._waiting: deque[VisionFix] = deque()
        self._latencies_ms: deque[float] = deque(maxlen=_LATENCIES)
        self._fresh: VisionFix | None = None
        self._reset_pending = False
        self._reset_counter = 0
        self._newest_ns = 0
        self._last_slot_ns = 0
        self._last_stamp_ns = 0
        self._last_was_fill = False
        self._intervals_ns: deque[int] = deque(maxlen=_INTERVALS)
        self._taken_ns = self._sent_fix_ns = 0
        self.yaw_difference_rad = NAN
        self.reason = NO_FIX_YET
        self.counters: Counter[str] = Counter()

    @property
    def reset_counter(self) -> int:
        """The counter of the last message."""
        return self._reset_counter

    @property
    def waiting(self) -> int:
        """How many fixes are not of age yet."""
        return len(self._waiting)

    @property
    def latency_ms(self) -> float:
        """Median age of the last 50 fixes when they came; NaN before the first."""
        return statistics.median(self._latencies_ms) if self._latencies_ms else NAN

    @property
    def latency_is_known(self) -> bool:
        """Whether enough fixes came to judge by."""
        return len(self._latencies_ms) == _LATENCIES

    def submit(self, fix: VisionFix, now_ns: int) -> None:
        """Queue a fix; one that is late by seconds, from the future or out of order is dropped."""
        if fix.time_ns <= self._newest_ns:
            self.counters["fixes_out_of_order"] += 1
            self._keep_reset(fix)
            return
        if fix.time_ns > now_ns + _FUTURE_SLACK_NS:
            self.counters["fixes_from_future"] += 1
            self._keep_reset(fix)
            return
        if now_ns - fix.time_ns > _STALE_NS:
            self.counters["fixes_stale"] += 1
            self._keep_reset(fix)
            return
        self._newest_ns = fix.time_ns
        self._latencies_ms.append((now_ns - fix.time_ns) * 1e-6)
        self.counters["fixes"] += 1
        self._waiting.append(fix)
        if len(self._waiting) > _QUEUE:
            self.counters["fixes_overflowed"] += 1
            self._keep_reset(self._waiting.popleft())

    def announce_jump(self) -> None:
        """Raise the reset counter with the next message."""
        self._reset_pending = True

    def skip(self) -> None:
        """Nothing can be sent now: forget what waits, but not that the position jumped."""
        while self._waiting:
            self._keep_reset(self._waiting.popleft())
        self._fresh = None

    def step(self, now_ns: int, context: InjectionContext) -> Injection | None:
        """What to send now, if anything."""
        self._take_due(now_ns, context)
        outcome = self._next(now_ns, context)
        if outcome is None:
            return None
        self._last_slot_ns = now_ns
        if isinstance(outcome, Withheld):
            self.reason = outcome.reason
            self.counters[outcome.counter] += 1
            return None
        self.reason = ""
        self._last_stamp_ns = outcome.estimate.position.time_ns
        self._last_was_fill = not outcome.estimate.fresh
        self.counters["sent_fresh" if outcome.estimate.fresh else "sent_propagated"] += 1
        return outcome

    def next_due_ns(self, now_ns: int) -> int:
        """When `step` must be called next."""
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
            attitude = context.attitude_at(fix.time_ns)
            verdict = self.guard.check(fix.time_ns, fix.yaw_rad, attitude, reset=fix.reset)
            if math.isfinite(verdict.difference_rad):
                self.yaw_difference_rad = verdict.difference_rad
            self._keep_reset(fix)
            if not verdict.accept:
                self.counters["fixes_yaw_refused"] += 1
                continue
            self._note_interval(fix, now_ns)
            self._propagator.update(fix)
            if self._fresh is not None:
                self.counters["fixes_superseded"] += 1
            self._fresh = fix

    def _note_interval(self, fix: VisionFix, now_ns: int) -> None:
        last, self._taken_ns = self._propagator.fix, now_ns
        if last is not None and fix.time_ns - last.time_ns < _STALE_NS:
            self._intervals_ns.append(fix.time_ns - last.time_ns)

    def _overdue(self, now_ns: int) -> bool:
        """Whether the next fix should have come by now, judged by the usual interval."""
        if len(self._intervals_ns) < _INTERVALS_KNOWN:
            return False
        usual = statistics.median(self._intervals_ns)
        return now_ns - self._taken_ns > self._config.overdue_intervals * usual

    def _keep_reset(self, fix: VisionFix) -> None:
        """A jump must be told even when the fix that carried it is not sent itself."""
        self._reset_pending = self._reset_pending or fix.reset

    # --- what to send ----------------------------------------------------------------------------

    def _earliest_ns(self) -> int:
        """Not more than half as fast again as the wanted rate: 30 Hz never passes 50 Hz."""
        return self._last_slot_ns + int(self._period_ns / 1.5)

    def _fill_due_ns(self) -> int:
        """A propagated message waits for a late fix for half a period, once."""
        patience = 1.0 if self._last_was_fill else 1.5
        return self._last_slot_ns + int(self._period_ns * patience)

    def _next(self, now_ns: int, context: InjectionContext) -> Injection | Withheld | None:
        if self._propagator.fix is None and not self.guard.blocked:
            return None
        fill_due = now_ns >= self._fill_due_ns()
        if self.guard.blocked:
            self._fresh = None
            degrees = math.degrees(self.yaw_difference_rad)
            reason = f"vision yaw differs from the autopilot's by {degrees:+.1f} deg"
            return Withheld(reason, "withheld_yaw") if fill_due else None
        if self._fresh is not None and now_ns >= self._earliest_ns():
            fix, self._fresh = self._fresh, None
            too_old = now_ns - fix.time_ns > int(context.profile.max_delay_ms * 1e6)
            if not too_old and fix.time_ns > self._last_stamp_ns:
                return self._make(fix.time_ns, now_ns, context, fresh=True)
            fill_due = True
        return (
            self._make(now_ns - self._delay_ns, now_ns, context, fresh=False) if fill_due else None
        )

    def _make(
        self, time_ns: int, now_ns: int, context: InjectionContext, *, fresh: bool
    ) -> Injection | Withheld | None:
        fix = self._propagator.fix
        position = self._propagator.at(time_ns)
        if fix is None or position is None or time_ns <= self._last_stamp_ns:
            return None
        too_far = (time_ns - fix.time_ns) * 1e-9 > self._config.max_extrapolation_s
        if too_far or (not fresh and self._overdue(now_ns)):
            return Withheld(NO_FRESH_FIX, "withheld_stale")
        sigma = position.horizontal_sigma_m
        if sigma > self._config.max_sigma_m:
            return Withheld(f"covariance too large ({sigma:.1f} m)", "withheld_covariance")
        attitude = self._attitude(fix, time_ns, context)
        counter = (self._reset_counter + self._reset_pending) % 256
        estimate = Estimate(
            position,
            attitude,
            fix.attitude_sigma_rad,
            fix.quality,
            counter,
            fresh,
            repeated=fix.time_ns == self._sent_fix_ns,
        )
        outcome = self._message(estimate, now_ns, context)
        if isinstance(outcome, Injection):
            self._reset_counter, self._reset_pending = counter, False
            self._sent_fix_ns = fix.time_ns
        return outcome

    def _attitude(
        self, fix: VisionFix, time_ns: int, context: InjectionContext
    ) -> tuple[float, float, float]:
        """Vision attitude at time_ns: the fix's, turned as the autopilot turned since."""
        vision = (fix.roll_rad, fix.pitch_rad, fix.yaw_rad)
        if time_ns == fix.time_ns or not all(math.isfinite(angle) for angle in vision):
            return vision
        then, now = context.attitude_at(fix.time_ns), context.attitude_at(time_ns)
        if then is None or now is None:
            return vision
        turned = quat.multiply(quat.conjugate(then.quaternion), now.quaternion)
        return quat.to_euler(quat.multiply(quat.from_euler(*vision), turned))

    def _message(self, e: Estimate, now_ns: int, context: InjectionContext) -> Injection | Withheld:
        kind: InjectionMessage = self._config.message
        altitude = e.position.height_m - self._geoid_m
        if kind == "gps_input":
            week_ms = self._utc.gps_week_ms(e.position.time_ns)
            return Injection(gps_input(e, altitude, week_ms, self._config), e)
        if kind == "global_position_sensor":
            return Injection(global_position_sensor(e, altitude, now_ns), e)
        if context.origin is None:
            return Withheld("the EKF has no origin", "withheld_no_origin")
        ned = ned_from_origin(
            context.origin,
            e.position.latitude_deg,
            e.position.longitude_deg,
            altitude,
            context.profile.projection,
        )
        if math.hypot(*ned) > _FARTHEST_M:
            reason = f"the EKF origin is {math.hypot(*ned) * 1e-3:.0f} km away"
            return Withheld(reason, "withheld_far_origin")
        formula = context.profile.covariance
        if self._config.covariance != "profile":
            formula = self._config.covariance
        if kind == "odometry":
            return self._odometry(e, ned, formula, context)
        if not self._config.send_attitude:
            e = replace(e, attitude=(NAN, NAN, NAN))
        return Injection(vision_position_estimate(e, ned, formula), e)

    def _odometry(
        self,
        e: Estimate,
        ned: tuple[float, float, float],
        formula: CovarianceFormula,
        context: InjectionContext,
    ) -> Injection | Withheld:
        """Velocity is rotated by the message's quaternion, so there must be one."""
        if not all(math.isfinite(angle) for angle in e.attitude):
            now = context.attitude_at(e.position.time_ns)
            if now is None:
                return Withheld("no attitude for ODOMETRY", "withheld_no_attitude")
            e = replace(e, attitude=(now.roll_rad, now.pitch_rad, now.yaw_rad))
        return Injection(odometry(e, ned, formula, context.profile.odometry_frame), e)
