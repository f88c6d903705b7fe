"""Detects a second vehicle, a second companion and other senders: wrong wiring, or forgery."""

from __future__ import annotations

from collections import Counter
from typing import Any

from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.link import Link
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.readings import is_autopilot
from mavlink_bridge.vehicle.tracker import VehicleTracker

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
