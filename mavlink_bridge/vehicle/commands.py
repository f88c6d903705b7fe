"""Sends commands to the flight controller and recognizes the answers to them."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.link.link import Link

_PARAMETERS = 7


class Commander:
    """Sends commands to the autopilot from our component id."""

    def __init__(self, component: int) -> None:
        self._component = component

    def send(self, link: Link, command: int, *parameters: float) -> None:
        """Send COMMAND_LONG (76) to the autopilot once; parameters 1 to 7, missing ones are 0. Does
        not wait for the answer.
        """
        padded = [*parameters, *([0.0] * (_PARAMETERS - len(parameters)))]
        message = mavlink.MAVLink_command_long_message(
            link.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, command, 0, *padded
        )
        link.send(message, self._component)

    def send_int(self, link: Link, command: int, frame: int, place: tuple[int, int, float]) -> None:
        """Send COMMAND_INT (75) to the autopilot once, with parameters 1 to 4 zero; does not wait
        for the answer. frame: MAV_FRAME; place: latitude, longitude (1e-7 deg), altitude (m).
        """
        message = mavlink.MAVLink_command_int_message(
            link.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, frame, command, 0, 0, 0, 0, 0, 0, *place
        )
        link.send(message, self._component)

    def is_ours(self, link: Link, ack: Any) -> bool:
        """Whether a COMMAND_ACK (77) answers a command of ours.

        Its target fields are extensions: 0 from old firmware.
        """
        return ack.target_system in (0, link.system_id) and ack.target_component in (
            0,
            self._component,
        )


def is_accepted(ack: Any) -> bool:
    """Whether a COMMAND_ACK says that the command was or is being executed."""
    return ack.result in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
