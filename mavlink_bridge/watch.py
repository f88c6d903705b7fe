"""Whether the flight controller is there, told once by whichever link notices first."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.messages import VehicleState

log = logging.getLogger(__name__)


class VehicleWatch:
    """Every link asks with each tick: the flight controller's own may be waiting to reconnect.

    say: tell the operator (severity, text).
    """

    def __init__(self, say: Callable[[int, str], None]) -> None:
        self._say = say
        self._lock = threading.Lock()
        self._connected: bool | None = None

    def check(self, state: VehicleState) -> None:
        """Tell what changed since the last call."""
        with self._lock:
            before, now = self._connected, state.connected
            if now == before or (before is None and not now):
                return
            self._connected = now
        if before is None:
            log.info("flight controller found: system %s", state.system_id)
        elif now:
            self._say(mavlink.MAV_SEVERITY_INFO, "PiLoT: flight controller is back")
        else:
            self._say(
                mavlink.MAV_SEVERITY_WARNING,
                "PiLoT: flight controller lost: no heartbeat for 3 s",
            )
