"""Requests and reads the EKF origin over the link, and sets it if the vehicle has none."""

from __future__ import annotations

from collections import Counter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import Origin
from mavlink_bridge.status_notifier import StatusNotifier
from mavlink_bridge.vehicle.commands import Commander
from mavlink_bridge.vehicle.origin import OriginKeeper
from mavlink_bridge.vehicle.tracker import VehicleTracker

_AGAIN_NS = 10_000_000_000


class OriginExchange:
    """Exchanges the EKF origin over the link and passes it to the tracker; one thread."""

    def __init__(
        self,
        config: BridgeConfig,
        tracker: VehicleTracker,
        commander: Commander,
        notifier: StatusNotifier,
        counters: Counter[str],
    ) -> None:
        self._keeper = OriginKeeper(config.origin)
        self._component = config.companion_component
        self._tracker = tracker
        self._commander = commander
        self._notifier = notifier
        self._counters = counters
        self._told: dict[AlertId, int] = {}

    @property
    def origin(self) -> Origin | None:
        """The EKF's origin; None while unknown."""
        return self._keeper.origin

    def on_message(self, message: Any, time_ns: int) -> None:
        """Process GPS_GLOBAL_ORIGIN (49). The same alert is reported at most every 10 s."""
        armed = self._tracker.snapshot(time_ns).armed
        news = self._keeper.on_origin(message, armed=armed)
        moved_m = self._keeper.moved_m
        if moved_m is not None:
            self._counters["origins_refused"] += 1
            self._notifier.notify("origin", alert(AlertId.ORIGIN_REFUSED, metres=moved_m))
        self._tracker.set_origin(self._keeper.origin)
        if news is not None and time_ns - self._told.get(news.id, -_AGAIN_NS) >= _AGAIN_NS:
            self._told[news.id] = time_ns
            self._notifier.report(news)

    def forget(self) -> None:
        """Forget the origin and request it again; nothing relative to it is sent meanwhile."""
        self._keeper.reset()
        self._tracker.set_origin(None)

    def tick(self, link: Link, now_ns: int, *, may_set: bool) -> None:
        """Request the origin if due, and set the configured one if there is none and may_set."""

        def ask(wanted: int) -> None:
            self._commander.send(link, mavlink.MAV_CMD_REQUEST_MESSAGE, wanted)

        message = self._keeper.tick(now_ns, link.system_id, ask)
        if message is not None and may_set:
            self._counters["origins_sent"] += 1
            link.send(message, self._component)
