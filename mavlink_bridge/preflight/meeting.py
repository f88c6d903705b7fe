"""Who is there: the first autopilot that is heard on a connection."""

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
class MetAutopilot:
    """An autopilot's MAVLink system id, and its firmware's name."""

    system_id: int
    firmware: str


class _Greeting(VehicleClient):
    """Listens for a heartbeat only."""

    def take(self, message: Any) -> None:
        """Nothing else was asked for."""


def meet(config: BridgeConfig) -> MetAutopilot:
    """The autopilot at `config.connection`; ConnectionSilentError where none is heard."""
    with _Greeting(config, "meeting", ()) as client:
        number = client.autopilot
        return MetAutopilot(client.system, _FIRMWARES.get(number, f"MAV_AUTOPILOT {number}"))
