"""Sends an alert to the operator after the flight process has died, over its links.

Each link is opened, the autopilot's next message gives its address and system id, the alert is
sent, and the link is closed before the restarted process needs it.
"""

from __future__ import annotations

import threading
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.link.link import Link, LinkOptions
from mavlink_bridge.link.transport import Endpoint
from mavlink_bridge.status import status_text

_PATIENCE_NS = 400_000_000  # for the autopilot to be heard; a guess is better than silence
_TICK_NS = 50_000_000
_FIRST_GUESS = 1
# What an autopilot sends often: the first of them tells its system id.
_HEARD = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mavlink.MAVLINK_MSG_ID_RAW_IMU,
    }
)


class _Speaker:
    """Handler of one link: sends the alert once it knows the system id, then sets `sent`. hears:
    whether the autopilot is on the link.
    """

    def __init__(self, message: Any, component: int, system: int | None, *, hears: bool) -> None:
        self.sent = threading.Event()
        self._message, self._component = message, component
        self._system, self._hears = system, hears
        self._opened_ns = 0

    def on_open(self, link: Link) -> None:
        """Start to wait for the autopilot's message."""
        self._opened_ns = monotonic_ns()

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """Send the alert with the autopilot's system id."""
        if message.get_srcComponent() == mavlink.MAV_COMP_ID_AUTOPILOT1:
            link.keep_peer()
            self._send(link, self._system or message.get_srcSystem())

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Without an autopilot on the link, or after 0.4 s: send by the configured system id."""
        waited = self._opened_ns and now_ns - self._opened_ns > _PATIENCE_NS
        if self._opened_ns and (waited or not self._hears):
            self._send(link, self._system or _FIRST_GUESS)
        return now_ns + _TICK_NS

    def _send(self, link: Link, system: int) -> None:
        if not self.sent.is_set():
            link.system_id = system
            link.send(self._message, self._component)
            self.sent.set()


def report_without_bridge(config: BridgeConfig, alert: Alert, timeout_s: float = 0.8) -> bool:
    """Open every link of the bridge, send an alert, and close them again; for the supervisor after
    the flight process died, because a live one holds the links.

    True if it was sent on at least one within `timeout_s` (for all links together); whether anybody
    received it is unknown. `SigningKeyError` for an unusable key file.
    """
    message = status_text(alert)
    spoken = []
    ends = [(config.connection, config.signing, True)]
    if config.ground_connection is not None:
        ends.append((config.ground_connection, config.ground_signing, False))
    for connection, signing, hears in ends:
        speaker = _Speaker(message, config.companion_component, config.system_id, hears=hears)
        options = LinkOptions(name="last words", wanted=_HEARD, signing=signing)
        link = Link(Endpoint.parse(connection), speaker, options)
        link.start()
        spoken.append((speaker, link))
    end_ns = monotonic_ns() + int(timeout_s * 1e9)
    sent = [s.sent.wait(max(end_ns - monotonic_ns(), 0) * 1e-9) for s, _ in spoken]
    for _, link in spoken:
        link.stop()
    return any(sent)
