"""Compares positions with GNSS, and checks whether the EKF follows the sent ones."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import InjectionMessage
from mavlink_bridge.injection.encode import EncodedEstimate
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.injection.shadow import ShadowScorer, gnss_healthy
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.shared import Shared
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.origin import north_east, offset
from mavlink_bridge.vehicle.origin_exchange import OriginExchange

_SETTLE_NS = 3_000_000_000
_WINDOW_NS = 3_000_000_000
_SILENT_NS = 1_000_000_000
_COMPARE_AFTER_NS = 300_000_000
_SIGMAS = 5.0
_SLACK_M = 2.0
_MINIMUM_HZ = 4.0
_GPS_MINIMUM_HZ = 4.65  # an average gap over 215 ms makes ArduPilot's receiver unhealthy
_VARIANCE_LIMIT = 1.0  # the innovation test's own threshold
_TAKES_NS = 200_000_000  # from arrival to where the EKF's output shows a jump
_JUMP_SAMPLES = 3
_JUMP_SIGMAS, _JUMP_SLACK_M = 3.0, 1.0  # to announce it once too often costs nothing
_MOST_REPEATS = 5


@dataclass(frozen=True)
class LoopVerdict:
    """Whether the EKF follows the sent positions. reason: why not, else None.

    difference_m: median horizontal distance between sent and estimated position.
    """

    used: bool
    reason: Alert | None
    difference_m: float | None


class ClosedLoopCheck:
    """Compares sent positions with the EKF's; one thread. message: kind of the sent messages.

    jumping: the EKF was not yet seen at the positions after the last announced jump.
    """

    def __init__(self, message: InjectionMessage) -> None:
        self.jumping = False
        self._message = message
        self._sent: deque[tuple[int, float, float, float]] = deque(maxlen=256)
        self._pending: deque[tuple[int, float, float, float]] = deque(maxlen=256)
        self._differences: deque[tuple[int, float, float, int]] = deque(maxlen=256)
        self._began_ns: int | None = None
        self._reset_counter: int | None = None
        self._jump_ns: int | None = None
        self._announced_ns = 0
        self._repeats = 0

    def add_sent(
        self,
        stamp_ns: int,
        now_ns: int,
        north: float,
        east: float,
        sigma_m: float,
        reset_counter: int = 0,
    ) -> None:
        """Add a position that was sent at now_ns: valid at stamp_ns, metres north and east of the
        EKF origin, with a horizontal sigma. A reset_counter unlike the one before announces a jump.
        """
        if self._reset_counter not in (None, reset_counter):
            self._jump_ns = now_ns + _TAKES_NS
            self._announced_ns, self.jumping = now_ns, True
        self._reset_counter = reset_counter
        if not self._sent or now_ns - self._sent[-1][0] > _SETTLE_NS:
            self._began_ns = now_ns
        self._sent.append((now_ns, north, east, sigma_m))
        self._pending.append((stamp_ns, north, east, sigma_m))

    def verdict(
        self,
        now_ns: int,
        state: VehicleState,
        local_at: Callable[[int], tuple[float, ...] | None],
    ) -> LoopVerdict | None:
        """The verdict of the last 3 s; None before, or while nothing is sent. local_at: the EKF's
        position (north, east, down) at a time, m.
        """
        self._compare(now_ns, local_at)
        recent = [s for s in self._sent if now_ns - s[0] < _WINDOW_NS]
        if not recent or self._began_ns is None or now_ns - self._began_ns < _SETTLE_NS:
            return None
        if now_ns - recent[-1][0] > _SILENT_NS:
            return None  # that nothing is sent is told by who does not send it
        differences = sorted(d for t, d, *_ in self._differences if now_ns - t < _WINDOW_NS)
        difference = differences[len(differences) // 2] if differences else None
        span_s = (recent[-1][0] - recent[0][0]) * 1e-9
        rate = (len(recent) - 1) / span_s if span_s > 0.0 else 0.0
        sigma = recent[-1][3]
        reason = self._reason(rate, state, difference, sigma)
        after_jump = now_ns - self._announced_ns > _WINDOW_NS + _COMPARE_AFTER_NS + _TAKES_NS
        if after_jump and difference is not None and _is_there(difference, sigma):
            self.jumping, self._repeats = False, 0  # another jump may be missed as often
        return LoopVerdict(reason is None, reason, difference)

    def is_jump_missed(self) -> bool:
        """Whether an announced jump must be announced again, because the EKF did not follow: True
        once for each announcement, up to five times.

        In each of its steps ArduPilot's EKF uses only the newest measurement. If two arrive
        together, it never uses the first one, which had the new reset_counter. It then refuses all
        positions, for 7 s (VISION_POSITION_ESTIMATE) or without end (ODOMETRY).
        """
        if self._jump_ns is None:
            return False
        after = [(d, sigma) for _, d, sigma, stamp in self._differences if stamp >= self._jump_ns]
        if len(after) < _JUMP_SAMPLES:
            return False
        self._jump_ns = None
        distance, sigma = sorted(after)[len(after) // 2]
        if _is_there(distance, sigma):
            self._repeats = 0
            return False
        self._repeats += 1
        return self._repeats <= _MOST_REPEATS

    def _compare(self, now_ns: int, local_at: Callable[[int], tuple[float, ...] | None]) -> None:
        """Compare each sent position with the EKF's at the same time, 0.3 s after that time."""
        while self._pending and now_ns - self._pending[0][0] > _COMPARE_AFTER_NS:
            stamp_ns, north, east, sigma = self._pending.popleft()
            local = local_at(stamp_ns)
            if local is not None:
                distance = math.hypot(local[0] - north, local[1] - east)
                self._differences.append((now_ns, distance, sigma, stamp_ns))

    def _reason(
        self, rate: float, state: VehicleState, difference: float | None, sigma: float
    ) -> Alert | None:
        needed = _GPS_MINIMUM_HZ if self._message == "gps_input" else _MINIMUM_HZ
        flags = state.ekf_flags
        no_init = bool(flags & mavlink.EKF_UNINITIALIZED) and state.autopilot == "ardupilot"
        off_m = difference or 0.0
        found = (
            (rate < needed, alert(AlertId.FIX_RATE_LOW, hertz=rate, needed=needed)),
            (no_init, alert(AlertId.EKF_NOT_INITIALISED)),
            (bool(flags & mavlink.EKF_CONST_POS_MODE), alert(AlertId.EKF_NO_SOURCE)),
            (difference is None, alert(AlertId.EKF_NO_POSITION)),
            (off_m > _SIGMAS * sigma + _SLACK_M, alert(AlertId.EKF_OFF_FIXES, metres=off_m)),
            (
                (state.ekf_horizontal_variance or 0.0) > _VARIANCE_LIMIT,
                alert(AlertId.EKF_REJECTS_FIXES),
            ),
        )
        return next((reason for holds, reason in found if holds), None)


def _is_there(distance_m: float, sigma_m: float) -> bool:
    """Whether the EKF is at the sent position, so that it has followed an announced jump."""
    return distance_m <= _JUMP_SIGMAS * sigma_m + _JUMP_SLACK_M


_QUEUE = 64
_REFERENCE_WAIT_NS = 500_000_000
_RECEIVER_LATE_NS = 200_000_000  # from what it measured to the arrival of its report


class InjectionOutcome:
    """Keeps recent computed and sent positions, for the shadow check and the check of the EKF; one
    thread.

    verdict: the last result of the check of the EKF; None while nothing is sent or it is too early.
    ekf_ok_inhibited_by: alerts for which "the EKF follows" is not reported. compared_ns: exposure
    of the last fix that was compared with GNSS, 0 for none.
    """

    def __init__(
        self,
        shared: Shared,
        origin: OriginExchange,
        notifier: StatusNotifier,
        counters: Counter[str],
    ) -> None:
        self.shadow = ShadowScorer(shared.geoid_separation_m)
        self.verdict: LoopVerdict | None = None
        self.ekf_ok_inhibited_by: frozenset[AlertId] = frozenset()
        self.compared_ns = 0
        self._loop = ClosedLoopCheck(shared.config.injection.message)
        self._tracker = shared.tracker
        self._origin = origin
        self._notifier = notifier
        self._counters = counters
        self._to_compare: deque[PropagatedFix] = deque(maxlen=_QUEUE)

    def add_computed(self, estimate: EncodedEstimate) -> None:
        """Add a due estimate, sent or not, to compare with GNSS; propagated ones are ignored."""
        if estimate.fresh:
            self._to_compare.append(estimate.position)

    def add_sent(self, estimate: EncodedEstimate, now_ns: int) -> None:
        """Add a sent estimate, for the check of the EKF; ignored without an EKF origin."""
        origin, position = self._origin.origin, estimate.position
        if origin is None:
            return
        north, east = north_east(
            origin.latitude_deg,
            origin.longitude_deg,
            position.latitude_deg,
            position.longitude_deg,
        )
        self._loop.add_sent(
            position.time_ns,
            now_ns,
            north,
            east,
            position.horizontal_sigma_m,
            estimate.reset_counter,
        )

    def compare(self, state: VehicleState, now_ns: int, *, on_gnss: bool | None) -> None:
        """Compare fixes, 0.5 s after exposure, with the EKF's position while it uses GNSS.

        on_gnss: whether the EKF uses GNSS; None if unknown, then the receiver's position is used.
        """
        while self._to_compare and now_ns - self._to_compare[0].time_ns > _REFERENCE_WAIT_NS:
            fix = self._to_compare.popleft()
            reference = self._tracker.global_at(fix.time_ns)
            if reference is not None and on_gnss is None:
                reference = _by_receiver(state, fix, reference[2])
            if reference is not None and on_gnss is not False and gnss_healthy(state, now_ns):
                self.shadow.compare(fix, reference)
                self.compared_ns = fix.time_ns

    def check_ekf(self, state: VehicleState, now_ns: int) -> bool:
        """Update `verdict`, and report whether the EKF follows: also after each jump, when it is
        settled. True, once, if the caller must announce a jump again, which is reported.
        """
        self.verdict = self._loop.verdict(now_ns, state, self._tracker.local_at)
        unsettled = bool(self.ekf_ok_inhibited_by) or self._loop.jumping
        if unsettled:
            self._notifier.notify("loop", None)  # what was reported is of before
        if self.verdict is not None and (self.verdict.reason or not unsettled):
            follows = alert(AlertId.EKF_FOLLOWS)
            self._notifier.notify_settled("loop", self.verdict.reason, follows, now_ns)
        if not self._loop.is_jump_missed():
            return False
        self._counters["jumps_repeated"] += 1
        self._notifier.report(alert(AlertId.JUMP_REPEATED))
        return True


def _by_receiver(
    state: VehicleState, fix: PropagatedFix, altitude_m: float
) -> tuple[float, float, float] | None:
    """The receiver's position at the fix's time, extrapolated by the fix's velocity: latitude,
    longitude (degrees) and altitude_m; None without a position.
    """
    if state.gps_latitude_deg is None or state.gps_longitude_deg is None:
        return None
    seconds = (fix.time_ns - state.gps_time_ns + _RECEIVER_LATE_NS) * 1e-9
    north, east = (float(v) * seconds for v in fix.velocity_ned[:2])
    latitude, longitude = offset(state.gps_latitude_deg, state.gps_longitude_deg, north, east)
    return latitude, longitude, altitude_m
