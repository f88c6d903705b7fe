"""Reading and writing the flight controller's parameters, one by one and by name.

https://mavlink.io/en/services/parameter.html
"""

from __future__ import annotations

import struct
import threading
from types import TracebackType
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.errors import ParameterError
from mavlink_bridge.link import Link
from mavlink_bridge.signing import load_key
from mavlink_bridge.transport import Endpoint

_WANTED = frozenset((mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_PARAM_VALUE))
_RETRIES = 3
_ANSWER_S = 0.7
_CONNECT_S = 15.0
_FIRST_GUESS = 1
_INTEGER_FORMATS = {
    mavlink.MAV_PARAM_TYPE_UINT8: "<B3x",
    mavlink.MAV_PARAM_TYPE_INT8: "<b3x",
    mavlink.MAV_PARAM_TYPE_UINT16: "<H2x",
    mavlink.MAV_PARAM_TYPE_INT16: "<h2x",
    mavlink.MAV_PARAM_TYPE_UINT32: "<I",
    mavlink.MAV_PARAM_TYPE_INT32: "<i",
}


def decode_value(value: float, kind: int, *, bytewise: bool) -> float:
    """The number in PARAM_VALUE: PX4 puts an integer's bytes into the float, ArduPilot casts."""
    if bytewise and kind in _INTEGER_FORMATS:
        return float(struct.unpack(_INTEGER_FORMATS[kind], struct.pack("<f", value))[0])
    return float(value)


def encode_value(value: float, kind: int, *, bytewise: bool) -> float:
    """Inverse of `decode_value`."""
    if bytewise and kind in _INTEGER_FORMATS:
        raw = struct.pack(_INTEGER_FORMATS[kind], round(value))
        return float(struct.unpack("<f", raw)[0])
    return value


class ParameterClient:
    """A link of its own to the flight controller, for parameters only. A context manager."""

    def __init__(self, config: BridgeConfig) -> None:
        key = None if config.signing is None else load_key(config.signing.key_file)
        self._config = config
        self._link = Link(
            Endpoint.parse(config.connection),
            self,
            name="parameters",
            wanted=_WANTED,
            signing_key=key,
            signing_link_id=1 if config.signing is None else config.signing.link_id,
        )
        self._changed = threading.Condition()
        self._system = 0
        self._component = mavlink.MAV_COMP_ID_AUTOPILOT1
        self._bytewise = False
        self._values: dict[str, tuple[float, int]] = {}
        self._next_heartbeat_ns = 0

    def __enter__(self) -> ParameterClient:
        self._link.start()
        with self._changed:
            found = self._changed.wait_for(lambda: self._system != 0, _CONNECT_S)
        if not found:
            self._link.stop()
            raise ParameterError(
                f"no autopilot heartbeat at {self._config.connection} in {_CONNECT_S:.0f} s; "
                "check the connection string, the wiring and the port's MAVLink 2 protocol"
            )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._link.stop()

    def read(self, name: str) -> float | None:
        """The parameter's value; None when the flight controller does not know it."""
        with self._changed:
            self._values.pop(name, None)
        request = mavlink.MAVLink_param_request_read_message(
            self._system, self._component, name.encode("ascii"), -1
        )
        for _ in range(_RETRIES):
            self._link.send(request, self._config.companion_component)
            if self._wait(name):
                return self._values[name][0]
        return None

    def write(self, name: str, value: float) -> None:
        """Set a parameter and check what the flight controller made of it."""
        if self.read(name) is None:
            raise ParameterError(f"{name}: the flight controller has no such parameter")
        kind = self._values[name][1]
        for _ in range(_RETRIES):
            with self._changed:
                self._values.pop(name, None)
            message = mavlink.MAVLink_param_set_message(
                self._system,
                self._component,
                name.encode("ascii"),
                encode_value(value, kind, bytewise=self._bytewise),
                kind,
            )
            self._link.send(message, self._config.companion_component)
            if self._wait(name) and abs(self._values[name][0] - value) < 1e-3 * max(1, abs(value)):
                return
        raise ParameterError(f"{name} = {value:g} was not taken by the flight controller")

    def _wait(self, name: str) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: name in self._values, _ANSWER_S)

    # --- link handler ---------------------------------------------------------------------------

    def on_open(self, link: Link) -> None:
        """Nothing to say before a heartbeat."""

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """Heartbeat and PARAM_VALUE of the autopilot."""
        if message.get_type() == "HEARTBEAT":
            if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID or (
                self._config.system_id not in (None, message.get_srcSystem())
            ):
                return
            link.system_id = message.get_srcSystem()
            with self._changed:
                self._system, self._component = link.system_id, message.get_srcComponent()
                self._bytewise = message.autopilot == mavlink.MAV_AUTOPILOT_PX4
                self._changed.notify_all()
        elif message.get_srcSystem() == self._system:
            value = decode_value(message.param_value, message.param_type, bytewise=self._bytewise)
            with self._changed:
                self._values[message.param_id] = (value, message.param_type)
                self._changed.notify_all()

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Heartbeat, so that the flight controller answers on this link."""
        if link.endpoint.kind == "udpout" and link.system_id == 0:
            link.system_id = _FIRST_GUESS
        if link.system_id and now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + 1_000_000_000
            message = mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 3, 3
            )
            link.send(message, self._config.companion_component)
        return now_ns + 100_000_000
