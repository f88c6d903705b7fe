"""Commands to the flight controller, and which answers are to ours."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.link.link import Link

_PARAMETERS = 7


class Commander:
    """Sends COMMAND_LONG (76) as the component of this id."""

    def __init__(self, component: int) -> None:
        self._component = component

    def send(self, link: Link, command: int, *parameters: float) -> None:
        """One command to the autopilot; parameters that are not given are 0."""
        padded = [*parameters, *([0.0] * (_PARAMETERS - len(parameters)))]
        message = mavlink.MAVLink_command_long_message(
            link.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, command, 0, *padded
        )
        link.send(message, self._component)

    def send_int(self, link: Link, command: int, frame: int, place: tuple[int, int, float]) -> None:
        """One command with a place: COMMAND_INT (75), latitude and longitude in 1e-7 degrees."""
        message = mavlink.MAVLink_command_int_message(
            link.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, frame, command, 0, 0, 0, 0, 0, 0, *place
        )
        link.send(message, self._component)

    def is_ours(self, link: Link, ack: Any) -> bool:
        """Whether a COMMAND_ACK (77) answers us, and not somebody else's command.

        Its target fields are extensions: 0 from old firmware.
        """
        return ack.target_system in (0, link.system_id) and ack.target_component in (
            0,
            self._component,
        )


def accepted(ack: Any) -> bool:
    """Whether a COMMAND_ACK says that the command was or is being carried out."""
    return ack.result in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
