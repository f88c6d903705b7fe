"""Whether the flight controller is there, told once by whichever link notices first."""

from __future__ import annotations

import threading
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.clock import monotonic_ns
from mavlink_bridge.messages import VehicleState

_PATIENCE_NS = 5_000_000_000
_TEXTS = {
    "there": (mavlink.MAV_SEVERITY_INFO, "flight controller found"),
    "lost": (mavlink.MAV_SEVERITY_WARNING, "flight controller lost: no heartbeat for 3 s"),
    "silent": (mavlink.MAV_SEVERITY_WARNING, "no heartbeat from the flight controller"),
}


class VehicleWatch:
    """Every link asks with each tick: the flight controller's own may be waiting to reconnect.

    say: tell the operator (severity, text).
    """

    def __init__(self, say: Callable[[int, str], None]) -> None:
        self._say = say
        self._lock = threading.Lock()
        self._begun_ns = monotonic_ns()
        self._known = "nothing"

    def check(self, state: VehicleState) -> None:
        """Tell what changed since the last call."""
        with self._lock:
            before = self._known
            if state.connected:
                self._known = "there"
            elif before == "there":
                self._known = "lost"
            elif before == "nothing" and monotonic_ns() - self._begun_ns > _PATIENCE_NS:
                self._known = "silent"
            if self._known == before:
                return
        severity, text = _TEXTS[self._known]
        if before == "lost":
            text = "flight controller is back"
        self._say(severity, f"PiLoT: {text}")
