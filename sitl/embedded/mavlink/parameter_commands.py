"""The parameter protocol: list, read, set."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.aircraft import Aircraft
from sitl.embedded.mavlink.handling import Handler
from sitl.embedded.mavlink.server import SerialPort


class ParameterCommands:
    """Handlers by message name."""

    def __init__(self, vehicle: Aircraft) -> None:
        self._vehicle = vehicle
        self.messages: dict[str, Handler] = {
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
        }

    def _param_value(self, name: str, index: int) -> Any:
        p = self._vehicle.parameters
        return mavlink.MAVLink_param_value_message(
            name.encode(), p.encode_value(name), p.type_of(name), len(p), index
        )

    def _param_list(self, link: SerialPort, _message: Any) -> None:
        for index, name in enumerate(self._vehicle.parameters):
            link.send(self._param_value(name, index))

    def _param_read(self, link: SerialPort, message: Any) -> None:
        p = self._vehicle.parameters
        name = _text(message.param_id)
        found = name if message.param_index < 0 else p.name_at(message.param_index)
        if found is not None and found in p:
            link.send(self._param_value(found, p.index_of(found)))

    def _param_set(self, _link: SerialPort, message: Any) -> None:
        v = self._vehicle
        name = _text(message.param_id)
        p = v.parameters
        if name in p and p.set(name, p.decode_value(name, message.param_value)):
            # ArduPilot tells every link of a change, with an index of 65535.
            v.server.broadcast(self._param_value(name, 65535))


def _text(value: str | bytes) -> str:
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else value
    return text.rstrip("\0")
