"""Reads and writes the flight controller's parameters, one by one and by name.

https://mavlink.io/en/services/parameter.html
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.errors import ParameterError
from mavlink_bridge.preflight.client import VehicleClient

_RETRIES = 3
_ANSWER_S = 0.7
_INTEGER_FORMATS = {
    mavlink.MAV_PARAM_TYPE_UINT8: "<B3x",
    mavlink.MAV_PARAM_TYPE_INT8: "<b3x",
    mavlink.MAV_PARAM_TYPE_UINT16: "<H2x",
    mavlink.MAV_PARAM_TYPE_INT16: "<h2x",
    mavlink.MAV_PARAM_TYPE_UINT32: "<I",
    mavlink.MAV_PARAM_TYPE_INT32: "<i",
}


def decode_value(value: float, kind: int, *, bytewise: bool) -> float:
    """The value in PARAM_VALUE. kind: MAV_PARAM_TYPE; bytewise: PX4 copies an integer's bytes into
    the float field, ArduPilot converts the number.
    """
    if bytewise and kind in _INTEGER_FORMATS:
        return float(struct.unpack(_INTEGER_FORMATS[kind], struct.pack("<f", value))[0])
    return float(value)


def encode_value(value: float, kind: int, *, bytewise: bool) -> float:
    """The float to send in PARAM_SET for a parameter's value: the inverse of `decode_value`."""
    if bytewise and kind in _INTEGER_FORMATS:
        raw = struct.pack(_INTEGER_FORMATS[kind], round(value))
        return float(struct.unpack("<f", raw)[0])
    return value


class ParameterClient(VehicleClient):
    """Reads and writes parameters. A context manager."""

    def __init__(self, config: BridgeConfig) -> None:
        super().__init__(config, "parameters", (mavlink.MAVLINK_MSG_ID_PARAM_VALUE,))
        self._values: dict[str, tuple[float, int]] = {}

    def read(self, name: str) -> float | None:
        """Request a parameter from the vehicle, and return its value; None if it does not exist, or
        no answer comes in 2 s.
        """
        self._values.pop(name, None)
        for _ in range(_RETRIES):
            self._request(name)
            if self.wait_for(lambda: name in self._values, _ANSWER_S):
                return self._values[name][0]
        return None

    def read_known(self, names: Collection[str]) -> dict[str, float]:
        """Values by name of those parameters that were answered within 0.7 s. All are requested
        together and once, so that all missing ones cost one timeout.
        """
        for name in names:
            self._values.pop(name, None)
            self._request(name)
        self.wait_for(lambda: all(name in self._values for name in names), _ANSWER_S)
        return {name: self._values[name][0] for name in names if name in self._values}

    def write(self, name: str, value: float) -> None:
        """Set a parameter and verify it. `ParameterError` if it does not exist or the value is not
        accepted.
        """
        if self.read(name) is None:
            raise ParameterError(f"{name}: the flight controller has no such parameter")
        kind = self._values[name][1]
        message = mavlink.MAVLink_param_set_message(
            self.system,
            self.component,
            name.encode("ascii"),
            encode_value(value, kind, bytewise=self._bytewise),
            kind,
        )
        for _ in range(_RETRIES):
            self._values.pop(name, None)
            self.ask(message)
            answered = self.wait_for(lambda: name in self._values, _ANSWER_S)
            if answered and abs(self._values[name][0] - value) < 1e-3 * max(1, abs(value)):
                return
        raise ParameterError(f"{name} = {value:g} was not taken by the flight controller")

    def _request(self, name: str) -> None:
        to = (self.system, self.component)
        self.ask(mavlink.MAVLink_param_request_read_message(*to, name.encode("ascii"), -1))

    @property
    def _bytewise(self) -> bool:
        return bool(self.autopilot == mavlink.MAV_AUTOPILOT_PX4)

    def take(self, message: Any) -> None:
        """Process a PARAM_VALUE."""
        value = decode_value(message.param_value, message.param_type, bytewise=self._bytewise)
        self._values[message.param_id] = (value, message.param_type)
