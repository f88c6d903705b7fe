"""The mission protocol, from the ground station's end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.errors import PilotError
from sitl.ground.link import GroundLink
from sitl.ground.mission_steps import MissionStep
from sitl.ground.vehicle_record import AUTOPILOT, VEHICLE


class MissionClient:
    """Writes and reads the vehicle's mission."""

    def __init__(self, link: GroundLink) -> None:
        self._link = link

    def upload(self, steps: Sequence[MissionStep]) -> None:
        """Replace the vehicle's mission; the first step becomes item 1, after home. `PilotError` if
        the vehicle refuses it.
        """
        home = MissionStep(mavlink.MAV_CMD_NAV_WAYPOINT)
        items = [home, *steps]
        kinds = ("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK")
        with self._link.answers.expect(*kinds) as box:
            self._link.send(mavlink.MAVLink_mission_count_message(VEHICLE, AUTOPILOT, len(items)))
            while True:
                message = self._link.next_of(box, "the mission upload")
                if message.get_type() == "MISSION_ACK":
                    if message.type != mavlink.MAV_MISSION_ACCEPTED:
                        raise PilotError(f"the mission was refused (MISSION_ACK {message.type})")
                    return
                self._send_item(message.seq, items[message.seq])

    def _send_item(self, sequence: int, step: MissionStep) -> None:
        x = step.raw_x if step.raw_x is not None else round(step.latitude_deg * 1e7)
        self._link.send(
            mavlink.MAVLink_mission_item_int_message(
                VEHICLE,
                AUTOPILOT,
                sequence,
                mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
                step.command,
                0,
                1,
                *step.parameters,
                x,
                round(step.longitude_deg * 1e7),
                step.altitude_m,
            )
        )

    def download(self) -> list[Any]:
        """The vehicle's mission as MISSION_ITEM_INT messages, home first."""
        with self._link.answers.expect("MISSION_COUNT", "MISSION_ITEM_INT") as box:
            self._link.send(mavlink.MAVLink_mission_request_list_message(VEHICLE, AUTOPILOT))
            size = self._link.next_of(box, "the mission's size").count
            items = []
            for sequence in range(size):
                self._link.send(
                    mavlink.MAVLink_mission_request_int_message(VEHICLE, AUTOPILOT, sequence)
                )
                items.append(self._link.next_of(box, f"mission item {sequence}"))
        return items
