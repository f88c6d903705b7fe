"""A temporary connection to the autopilot, to read parameters or missions."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.errors import ConnectionSilentError
from mavlink_bridge.link.link import Link, LinkOptions
from mavlink_bridge.link.transport import Endpoint
from mavlink_bridge.vehicle.readings import is_autopilot

_CONNECT_S = 15.0
_FIRST_GUESS = 1
_FIRMWARES = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot",
    mavlink.MAV_AUTOPILOT_PX4: "PX4",
}

_Self = TypeVar("_Self", bound="VehicleClient")


class VehicleClient:
    """Finds the autopilot and keeps its link active by heartbeats. A context manager.

    Raises `ConnectionSilentError` if no heartbeat arrives. A subclass receives the autopilot's
    messages in `take`, which is called under the lock of `wait_for`.
    """

    def __init__(self, config: BridgeConfig, name: str, wanted: Collection[int]) -> None:
        self.config = config
        messages = {mavlink.MAVLINK_MSG_ID_HEARTBEAT, *wanted}
        options = LinkOptions(name=name, wanted=messages, signing=config.signing)
        self._link = Link(Endpoint.parse(config.connection), self, options)
        self._changed = threading.Condition()
        self.system = 0
        self.component = mavlink.MAV_COMP_ID_AUTOPILOT1
        self.autopilot = mavlink.MAV_AUTOPILOT_INVALID
        self.armed = False
        """As the heartbeat said that began the conversation."""
        self._next_heartbeat_ns = 0

    def __enter__(self: _Self) -> _Self:
        self._link.start()
        try:
            self.wait_for(lambda: self.system != 0, _CONNECT_S)
        finally:  # an interrupt included
            if not self.system:
                self._link.stop()
        if not self.system:
            raise ConnectionSilentError(
                f"no autopilot heartbeat at {self.config.connection} in {_CONNECT_S:.0f} s; "
                "check the connection string, the wiring and the port's MAVLink 2 protocol"
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._link.stop()

    def take(self, message: Any) -> None:
        """Process a message of the autopilot, other than its heartbeat."""

    def ask(self, message: Any) -> None:
        """Send a message as the companion; the answer comes to `take`, see `wait_for`."""
        self._link.send(message, self.config.companion_component)

    def wait_for(self, predicate: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until the predicate holds, tested after each message; False after the timeout."""
        with self._changed:
            return self._changed.wait_for(predicate, timeout_s)

    # --- link handler ---------------------------------------------------------------------------

    def on_open(self, link: Link) -> None:
        """Does nothing: nothing is sent before a heartbeat is received."""

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """Process the autopilot's heartbeat, or pass its other messages to `take`."""
        system = message.get_srcSystem()
        if message.get_type() == "HEARTBEAT":
            # The first one decides: a second vehicle on the link must not be given what was asked
            # of, or written for, the first.
            if self.system or self.config.system_id not in (None, system):
                return
            if not is_autopilot(message):
                return
            link.system_id = system
            link.keep_peer()
            with self._changed:
                self.system, self.component = system, message.get_srcComponent()
                self.autopilot = message.autopilot
                self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
                self._changed.notify_all()
        elif (system, message.get_srcComponent()) == (self.system, self.component):
            with self._changed:
                self.take(message)
                self._changed.notify_all()

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Send a heartbeat once a second, so that the autopilot answers on this link; returns the
        time of the next call, ns. On a link on which the autopilot speaks second, or that is
        signed, a system id is guessed until it has been heard.
        """
        if link.system_id == 0 and (link.endpoint.kind == "udpout" or self.config.signing):
            link.system_id = _FIRST_GUESS
        if link.system_id and now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + 1_000_000_000
            message = mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 3, 3
            )
            link.send(message, self.config.companion_component)
        return now_ns + 100_000_000


@dataclass(frozen=True)
class DetectedAutopilot:
    """MAVLink system id and firmware of a detected autopilot."""

    system_id: int
    firmware: str


def detect_autopilot(config: BridgeConfig) -> DetectedAutopilot:
    """The autopilot at `config.connection`; `ConnectionSilentError` without one for 15 s."""
    with VehicleClient(config, "meeting", ()) as client:
        number = client.autopilot
        return DetectedAutopilot(client.system, _FIRMWARES.get(number, f"MAV_AUTOPILOT {number}"))
