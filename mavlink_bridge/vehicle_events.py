"""Reports changes of the vehicle that concern the operator: found, lost, GNSS lost, arming."""

from __future__ import annotations

import threading
from collections.abc import Callable

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Output
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.status import StatusNotifier

_PATIENCE_NS = 5_000_000_000
_NEWS = {
    "there": AlertId.FC_FOUND,
    "lost": AlertId.FC_LOST,
    "silent": AlertId.FC_SILENT,
}


class VehicleWatch:
    """Reports found and lost vehicles. Every link calls `check` at each tick.

    report: sends an alert to the operator. first: called after the first of these alerts. clock:
    CLOCK_MONOTONIC, ns.
    """

    def __init__(
        self,
        report: Callable[[Alert], None],
        first: Callable[[], None] = lambda: None,
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._report, self._first, self._clock = report, first, clock
        self._lock = threading.Lock()
        # Of the first tick: an application may compile for minutes before it starts the bridge.
        self._begun_ns: int | None = None
        self._known = "nothing"

    def check(self, state: VehicleState) -> None:
        """Report whether the vehicle was found, lost or is back, or silent from the start."""
        now_ns = self._clock()
        with self._lock:
            before, self._begun_ns = self._known, self._begun_ns or now_ns
            if state.connected:
                self._known = "there"
            elif before == "there":
                self._known = "lost"
            elif before == "nothing" and now_ns - self._begun_ns > _PATIENCE_NS:
                self._known = "silent"
            if self._known == before:
                return
        self._report(Alert(AlertId.FC_BACK if before == "lost" else _NEWS[self._known]))
        if before == "nothing":
            self._first()


_LOST_NS = 1_000_000_000  # beyond the freshness of a report, 1.5 s
_PAID_BACK = 0.25  # of that time by each moment in which it is well: half of it is no GNSS
_BACK_NS = 5_000_000_000
_HELD_NS = 10_000_000_000
_FIRST_NS = 3_000_000_000  # for the first GNSS report, which a vehicle met in flight sends later


class VehicleEvents:
    """Reports each lasting change once. Called ten times a second by one thread."""

    def __init__(self, notifier: StatusNotifier) -> None:
        self._notifier = notifier
        self._gnss: bool | None = None  # None: never seen healthy
        self._back_ns: int | None = None  # since when it is well again
        self._bad_ns = self._looked_ns = 0  # for how long it was not, on balance
        self._armed = False
        self._unheard_ns: int | None = None  # since when it is armed, before any GNSS report
        self._held_ns: int | None = None

    def update(
        self, state: VehicleState, now_ns: int, *, injecting: bool, refused: bool = False
    ) -> None:
        """Report the loss and return of GNSS, and arming without it. injecting: positions are being
        sent. refused: GNSS contradicts vision, so it does not count as back.
        """
        healthy = gnss_healthy(state, now_ns)
        self._follow_gnss(healthy and not (refused and not self._gnss), now_ns, injecting=injecting)
        if state.armed and not state.gps_time_ns:
            self._unheard_ns = self._unheard_ns or now_ns
            if now_ns - self._unheard_ns < _FIRST_NS:
                return
        if state.armed and not self._armed and not healthy:
            self._notifier.report(alert(AlertId.ARMED_WITHOUT_GNSS, output=_output(injecting)))
        self._armed = state.armed

    def set_hold_reason(self, reason: Alert | None, now_ns: int) -> None:
        """Set the interlock's reason for not sending available fixes; None without one. A reason is
        reported once it has lasted 10 s, because the shadow check needs some seconds.
        """
        if reason is None:
            self._held_ns = None
            return
        self._held_ns = self._held_ns or now_ns
        if now_ns - self._held_ns >= _HELD_NS:
            self._notifier.notify("held", reason)

    def _follow_gnss(self, healthy: bool, now_ns: int, *, injecting: bool) -> None:
        passed_ns, self._looked_ns = min(now_ns - self._looked_ns, _LOST_NS), now_ns
        if not self._gnss:
            self._back_ns = (self._back_ns or now_ns) if healthy else None
            well = self._back_ns is not None and now_ns - self._back_ns >= _BACK_NS
            if healthy and (well or self._gnss is None):
                if self._gnss is not None:
                    self._notifier.report(alert(AlertId.GNSS_BACK))
                self._gnss, self._bad_ns = True, 0
            return
        change_ns = round(-_PAID_BACK * passed_ns) if healthy else passed_ns
        self._bad_ns = max(self._bad_ns + change_ns, 0)
        if self._bad_ns > _LOST_NS:
            self._gnss, self._back_ns = False, None
            self._notifier.report(alert(AlertId.GNSS_LOST, output=_output(injecting)))


def _output(injecting: bool) -> Output:
    return Output.INJECTING if injecting else Output.NOTHING
