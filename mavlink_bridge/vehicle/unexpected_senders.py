"""Detects a second vehicle, a second companion and other senders: wrong wiring, or forgery."""

from __future__ import annotations

from collections import Counter
from typing import Any

from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.link import Link
from mavlink_bridge.status_notifier import StatusNotifier
from mavlink_bridge.vehicle.presence import DuplicateSystemIdMonitor
from mavlink_bridge.vehicle.readings import is_autopilot
from mavlink_bridge.vehicle.tracker import VehicleTracker

_TURNS = 6  # armed and disarmed again three times: nobody flies so
_TURNS_IN_NS = 10_000_000_000
_LIES = 3  # of TIMESYNC, which is asked once a second


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
        self._twins = DuplicateSystemIdMonitor()
        self._turns = (0, 0)  # arming's at a time
        self._lies = (0, 0)  # of TIMESYNC likewise

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
        self._check_arming(link, now_ns)
        clock = self._tracker.clock
        self._check_answers(clock.contradictions, now_ns)
        ran_back = self._twins.is_duplicate(now_ns, clock.strays + clock.reboots)
        if ran_back or self._tracker.impostors:
            twins = alert(AlertId.DUPLICATE_SYSTEM_ID, system=link.system_id)
            self._notifier.notify("twins", twins)

    def _check_answers(self, now: int, now_ns: int) -> None:
        """TIMESYNC answers far from the vehicle's own time stamps come from another sender."""
        lies, since_ns = self._lies
        if now - lies >= _LIES:
            self._notifier.notify("answers", alert(AlertId.TIMESYNC_CONTRADICTS))
        if now - lies >= _LIES or now_ns - since_ns > _TURNS_IN_NS:
            self._lies = (now, now_ns)

    def _check_arming(self, link: Link, now_ns: int) -> None:
        """Heartbeats that alternate between armed and disarmed are forged."""
        turns, since_ns = self._turns
        now = self._tracker.arming.changes
        if now - turns >= _TURNS:
            forged = alert(AlertId.ARMING_ALTERNATES, system=link.system_id)
            self._notifier.notify("arming", forged)
        if now - turns >= _TURNS or now_ns - since_ns > _TURNS_IN_NS:
            self._turns = (now, now_ns)
