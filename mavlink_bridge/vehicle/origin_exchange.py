"""Requests and reads the EKF origin over the link, and sets it if the vehicle has none."""

from __future__ import annotations

import logging
import math
from collections import Counter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import BridgeConfig, OriginConfig
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import Origin
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.commands import Commander
from mavlink_bridge.vehicle.origin import north_east
from mavlink_bridge.vehicle.tracker import VehicleTracker

_log = logging.getLogger(__name__)

_AGAIN_NS = 10_000_000_000
_HIGHEST_M = 20_000.0  # of an origin, or as deep below the sea
_ASK_EVERY_NS = 1_000_000_000
_CHECK_EVERY_NS = 10_000_000_000
_ASKS_BEFORE_SETTING = 3


class OriginExchange:
    """Reads the vehicle's EKF origin, and sets the configured one only if there is none; one
    thread. origin: None while unknown.

    ArduPilot silently ignores a second origin, so only GPS_GLOBAL_ORIGIN shows the origin in use.
    """

    def __init__(
        self,
        config: BridgeConfig,
        tracker: VehicleTracker,
        commander: Commander,
        notifier: StatusNotifier,
        counters: Counter[str],
    ) -> None:
        self.origin: Origin | None = None
        self._configured = config.origin
        self._component = config.companion_component
        self._tracker = tracker
        self._commander = commander
        self._notifier = notifier
        self._counters = counters
        self._told: dict[AlertId, int] = {}
        self._asked = 0
        self._next_ns = 0

    def on_message(self, message: Any, time_ns: int) -> None:
        """Process GPS_GLOBAL_ORIGIN (49). The same alert is reported at most every 10 s.

        While the vehicle is armed, a known origin is kept. No EKF moves its origin in flight, and a
        forged origin would shift every position.
        """
        read = Origin(message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3)
        known = self.origin
        if not _is_plausible(read) or read == known:
            return
        if known is not None and self._tracker.snapshot(time_ns).armed:
            self._counters["origins_refused"] += 1
            refused = alert(AlertId.ORIGIN_REFUSED, metres=_distance_m(known, read))
            self._notifier.notify("origin", refused)
            return
        self.origin = read
        self._tracker.set_origin(read)
        news = _first_news(read, self._configured)
        if known is not None:
            news = alert(AlertId.ORIGIN_MOVED)
        if time_ns - self._told.get(news.id, -_AGAIN_NS) >= _AGAIN_NS:
            self._told[news.id] = time_ns
            self._notifier.report(news)

    def forget(self) -> None:
        """Forget the origin and request it again; nothing relative to it is sent meanwhile."""
        self.origin, self._asked, self._next_ns = None, 0, 0
        self._tracker.set_origin(None)

    def tick(self, link: Link, now_ns: int, *, may_set: bool) -> None:
        """Request the origin if due; after three requests without one, set the configured one if
        may_set.
        """
        if now_ns < self._next_ns:
            return
        self._next_ns = now_ns + (_ASK_EVERY_NS if self.origin is None else _CHECK_EVERY_NS)
        wanted = mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
        self._commander.send(link, mavlink.MAV_CMD_REQUEST_MESSAGE, wanted)
        if self.origin is not None:
            return
        self._asked += 1
        # After setting, one more question: the answer may be under way.
        patient = self._asked <= _ASKS_BEFORE_SETTING or self._asked % 2 == 1
        if self._configured is None or patient or not may_set:
            return
        if not self._counters["origins_sent"]:
            _log.info("the vehicle has no EKF origin: setting the configured one")
        self._counters["origins_sent"] += 1
        message = mavlink.MAVLink_set_gps_global_origin_message(
            link.system_id,
            round(self._configured.latitude_deg * 1e7),
            round(self._configured.longitude_deg * 1e7),
            round(self._configured.altitude_amsl_m * 1e3),
            now_ns // 1000,
        )
        link.send(message, self._component)


def _is_plausible(read: Origin) -> bool:
    """Whether it is an origin on Earth, and not 0, 0, which firmwares send before they have one."""
    if read.latitude_deg == 0.0 and read.longitude_deg == 0.0:
        return False
    if not abs(read.altitude_amsl_m) <= _HIGHEST_M:
        return False
    return abs(read.latitude_deg) <= 90.0 and abs(read.longitude_deg) <= 180.0


def _distance_m(a: Origin, b: Origin) -> float:
    north, east = north_east(a.latitude_deg, a.longitude_deg, b.latitude_deg, b.longitude_deg)
    return math.hypot(north, east, b.altitude_amsl_m - a.altitude_amsl_m)


def _first_news(read: Origin, configured: OriginConfig | None) -> Alert:
    """That the origin is known, or how far it is from the configured one."""
    if configured is not None:
        place = (configured.latitude_deg, configured.longitude_deg)
        apart = math.hypot(*north_east(*place, read.latitude_deg, read.longitude_deg))
        if apart > 1.0:
            return alert(AlertId.ORIGIN_DIFFERS, metres=apart)
    return alert(AlertId.ORIGIN_KNOWN)
