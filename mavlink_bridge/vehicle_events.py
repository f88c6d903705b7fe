"""Reports changes of the vehicle that concern the operator, and unexpected senders."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name, Output
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.readings import is_autopilot
from mavlink_bridge.vehicle.tracker import VehicleTracker

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


_WINDOW_NS = 10_000_000_000
_TURNS = 6  # armed and disarmed again three times: nobody flies so
_LIES = 3  # of TIMESYNC, which is asked once a second
_TWIN_WINDOW_NS = 5_000_000_000
_TWIN_SWITCHES = 40  # in a window: even a line that damages every third frame is far below


class _Burst:
    """Detects a counter that increases by `least` within a time."""

    def __init__(self, least: int, within_ns: int = _WINDOW_NS) -> None:
        self._least, self._within_ns = least, within_ns
        self._count = self._begun_ns = 0

    def is_found(self, count: int, now_ns: int) -> bool:
        """Whether the counter has increased so much since the last find, or since the window began.
        count: its value at now_ns.
        """
        many = count - self._count >= self._least
        if many or now_ns - self._begun_ns > self._within_ns:
            self._count, self._begun_ns = count, now_ns
        return many


class UnexpectedSenderMonitor:
    """Checks for other senders and reports each kind once; one thread."""

    def __init__(
        self,
        config: BridgeConfig,
        tracker: VehicleTracker,
        notifier: StatusNotifier,
        counters: Counter[str],
    ) -> None:
        self._config = config
        self._tracker = tracker
        self._notifier = notifier
        self._counters = counters
        self._turns = _Burst(_TURNS)
        self._lies = _Burst(_LIES)
        self._ran_back = _Burst(_TWIN_SWITCHES, _TWIN_WINDOW_NS)

    def on_message(self, link: Link, message: Any) -> None:
        """Process a message that is not the vehicle's; only its heartbeats are used."""
        if message.get_type() != "HEARTBEAT" or not link.system_id:
            return
        system, component = message.get_srcSystem(), message.get_srcComponent()
        config, tell = self._config, self._notifier.notify
        ours = (config.localizer_component, config.companion_component, config.camera_component)
        if system == link.system_id and component in ours:
            tell("twin", alert(AlertId.SECOND_COMPANION, component=component))
        elif system == link.system_id and is_autopilot(message):
            self._counters["other_autopilots"] += 1
            tell("twins", alert(AlertId.DUPLICATE_SYSTEM_ID, system=system))
        elif config.system_id is None and is_autopilot(message):
            self._counters["other_autopilots"] += 1
            used = link.system_id
            tell("others", alert(AlertId.AUTOPILOT_IGNORED, system=system, used=used))

    def check(self, link: Link, now_ns: int) -> None:
        """Detect other hosts and gimbals, false clocks, forged arming, duplicate ids."""
        if link.stranger:
            ignored = alert(AlertId.SENDER_IGNORED, sender=Name(link.stranger))
            self._notifier.notify_each("foreign", ignored)
        others = self._tracker.other_gimbals
        if others and not self._config.camera.gimbal_component:
            component, device = others[0]
            ignored = alert(AlertId.GIMBAL_IGNORED, component=component, device=device)
            self._notifier.notify("gimbals", ignored)
        clock, system = self._tracker.clock, link.system_id
        # Heartbeats that alternate between armed and disarmed are forged.
        if self._turns.is_found(self._tracker.arming.changes, now_ns):
            self._notifier.notify("arming", alert(AlertId.ARMING_ALTERNATES, system=system))
        # TIMESYNC answers far from the vehicle's own time stamps come from another sender.
        if self._lies.is_found(clock.contradictions, now_ns):
            self._notifier.notify("answers", alert(AlertId.TIMESYNC_CONTRADICTS))
        # Boot times alternate if two vehicles have the same ids.
        ran_back = self._ran_back.is_found(clock.strays + clock.reboots, now_ns)
        if ran_back or self._tracker.impostors:
            self._notifier.notify("twins", alert(AlertId.DUPLICATE_SYSTEM_ID, system=system))
