"""The separate ground link, so that its messages use no bandwidth of the injection."""

from __future__ import annotations

from typing import Any

from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name
from mavlink_bridge.components import COMMANDS_IN, Components
from mavlink_bridge.link.link import Link
from mavlink_bridge.shared import Shared
from mavlink_bridge.status_notifier import StatusNotifier

_TICK_NS = 20_000_000


class GroundEnd:
    """Handles the ground link, in its thread; other threads only fill its components' queues."""

    def __init__(self, shared: Shared) -> None:
        self.components = Components(shared, ground=True)
        self._shared = shared
        self._notifier = StatusNotifier(shared.report)

    def on_open(self, link: Link) -> None:
        """Announce our components at once."""
        self.components.announce()

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """Process commands; a heartbeat of one of `ground_systems` selects the link's peer."""
        if message.get_type() == "HEARTBEAT":
            if message.get_srcSystem() in self._shared.config.ground_systems:
                link.keep_peer()
            return
        if message.get_type() in COMMANDS_IN:
            self.components.command(link, message, time_ns)

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Send heartbeats and targets once the system id is known; returns the next time, ns."""
        config = self._shared.config
        state = self._shared.tracker.snapshot(now_ns)
        link.system_id = config.system_id or state.system_id or 0
        self._shared.watch.check(state)
        if link.stranger:
            self._notifier.notify_each(
                "foreign", alert(AlertId.SENDER_IGNORED, sender=Name(link.stranger))
            )
        if link.system_id:
            self.components.heartbeat(link, now_ns)
            if config.camera.announce:
                self.components.serve_camera(link, state, now_ns)
        return now_ns + _TICK_NS
