"""Mission items as the scripted ground station writes them."""

from __future__ import annotations

from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink


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
