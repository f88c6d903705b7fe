"""Detects the first autopilot on a connection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.preflight.client import VehicleClient

_FIRMWARES = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot",
    mavlink.MAV_AUTOPILOT_PX4: "PX4",
}


@dataclass(frozen=True)
class DetectedAutopilot:
    """MAVLink system id and firmware of a detected autopilot."""

    system_id: int
    firmware: str


class _Greeting(VehicleClient):
    """Listens for a heartbeat only."""

    def take(self, message: Any) -> None:
        """Nothing else was asked for."""


def meet(config: BridgeConfig) -> DetectedAutopilot:
    """Detect the autopilot at `config.connection`; `ConnectionSilentError` without one."""
    with _Greeting(config, "meeting", ()) as client:
        number = client.autopilot
        return DetectedAutopilot(client.system, _FIRMWARES.get(number, f"MAV_AUTOPILOT {number}"))
