"""Compares positions with GNSS, and checks whether the EKF follows the sent ones."""

from __future__ import annotations

from collections import Counter, deque

from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.injection.closed_loop import ClosedLoopCheck, LoopVerdict
from mavlink_bridge.injection.encode import EncodedEstimate
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.injection.shadow import ShadowScorer, gnss_healthy
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.shared import Shared
from mavlink_bridge.status_notifier import StatusNotifier
from mavlink_bridge.vehicle.origin import north_east, offset
from mavlink_bridge.vehicle.origin_exchange import OriginExchange

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
