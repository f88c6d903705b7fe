"""The mission protocol, from the ground station's end, and the items that it sends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.errors import PilotError
from sitl.ground.link import GroundLink
from sitl.ground.vehicle_record import AUTOPILOT, VEHICLE


@dataclass(frozen=True)
class MissionStep:
    """A mission item; build it with the functions of this module."""

    command: int
    parameters: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    latitude_deg: float = 0.0
    longitude_deg: float = 0.0
    altitude_m: float = 0.0  # above home
    raw_x: int | None = None  # param5 of a command that is not a place


def takeoff_step(height_m: float) -> MissionStep:
    """Item: climb to a height above home."""
    return MissionStep(mavlink.MAV_CMD_NAV_TAKEOFF, altitude_m=height_m)


def waypoint_step(latitude_deg: float, longitude_deg: float, height_m: float) -> MissionStep:
    """Item: fly to a position at a height above home."""
    nothing = (0.0, 0.0, 0.0, 0.0)
    place = (latitude_deg, longitude_deg, height_m)
    return MissionStep(mavlink.MAV_CMD_NAV_WAYPOINT, nothing, *place)


def speed_step(speed_m_s: float) -> MissionStep:
    """Item: change the ground speed."""
    return MissionStep(mavlink.MAV_CMD_DO_CHANGE_SPEED, (1.0, speed_m_s, -1.0, 0.0))


def gimbal_step(pitch_deg: float, yaw_deg: float) -> MissionStep:
    """Item: point the gimbal; pitch from the horizon, up positive, yaw from the nose."""
    return MissionStep(
        mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
        (pitch_deg, yaw_deg, 0.0, 0.0),
        raw_x=0,
    )


def return_step() -> MissionStep:
    """Item: return to launch and land."""
    return MissionStep(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)


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
