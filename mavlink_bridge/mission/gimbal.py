"""Camera direction that a mission commands, as ArduPilot's AP_Mount and PX4 interpret it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.mission.items import (
    FRAMES,
    ROI_COMMANDS,
    HeightAbove,
    MissionItem,
    MissionVehicle,
)

_PITCH_LIMIT_DEG, _YAW_LIMIT_DEG = 90.0, 360.0  # AP_Mount takes nothing beyond
_MOVING_ROI = (mavlink.MAV_ROI_WPNEXT, mavlink.MAV_ROI_WPINDEX, mavlink.MAV_ROI_TARGET)
GIMBAL_COMMANDS = frozenset(
    (
        *ROI_COMMANDS,
        mavlink.MAV_CMD_DO_MOUNT_CONTROL,
        mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
    )
)


@dataclass(frozen=True)
class RegionOfInterest:
    """A position that the camera points at."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    above: HeightAbove


@dataclass(frozen=True)
class GimbalTarget:
    """Commanded camera direction. pitch_deg: above the horizon, None if not commanded; yaw_deg:
    clockwise from the vehicle's heading, or from north if `from_north`; roi: replaces both.
    """

    pitch_deg: float | None = None
    yaw_deg: float = 0.0
    from_north: bool = False
    roi: RegionOfInterest | None = None


def gimbal_after(
    item: MissionItem, before: GimbalTarget, vehicle: MissionVehicle
) -> tuple[GimbalTarget, str]:
    """Camera direction after one of `GIMBAL_COMMANDS`, and why it is unknown (empty if known).

    Angles that are not set leave the target as it is.
    """
    if item.command == mavlink.MAV_CMD_DO_MOUNT_CONTROL:
        return _mount_control(item, before, vehicle)
    if item.command == mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW:
        return _pitch_yaw(item, before, vehicle)
    return _roi(item, vehicle)


def _roi(item: MissionItem, vehicle: MissionVehicle) -> tuple[GimbalTarget, str]:
    # ArduPilot ends a region of interest at 0, 0, 0, and never looks at the mode (MAV_ROI).
    mode, altitude = item.parameters[0], item.altitude_m
    if item.command == mavlink.MAV_CMD_DO_SET_ROI_NONE:
        return GimbalTarget(), ""
    by_mode = item.command == mavlink.MAV_CMD_DO_SET_ROI and not vehicle.is_ardupilot
    if by_mode and mode in _MOVING_ROI and (vehicle.is_px4 or item.place is None):
        name = mavlink.enums["MAV_ROI"][int(mode)].name
        return GimbalTarget(), f"{name}: what it looks at is not known here"
    if item.place is None:
        return GimbalTarget(), "" if altitude is None else "it has an altitude and no coordinates"
    if item.frame not in FRAMES:
        return GimbalTarget(), f"its frame {item.frame} has no global coordinates"
    latitude, longitude = item.place
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):
        return GimbalTarget(), f"{latitude:g}, {longitude:g} is no place on Earth"
    roi = RegionOfInterest(latitude, longitude, altitude or 0.0, FRAMES[item.frame])
    return GimbalTarget(roi=roi), ""


def _mount_control(
    item: MissionItem, before: GimbalTarget, vehicle: MissionVehicle
) -> tuple[GimbalTarget, str]:
    """DO_MOUNT_CONTROL: ArduPilot uses the angles in any mode; Mission Planner leaves it 0."""
    pitch, _, yaw, *_, mode = item.parameters
    by_angles = mode == mavlink.MAV_MOUNT_MODE_MAVLINK_TARGETING or (
        not vehicle.is_px4 and (math.isnan(mode) or mode == 0)
    )
    if not by_angles:
        entry = mavlink.enums["MAV_MOUNT_MODE"].get(int(mode)) if math.isfinite(mode) else None
        name = f"mode {mode:g}" if entry is None else str(entry.name)
        return GimbalTarget(), f"{name}: where the camera looks is not known here"
    return _angles(before, pitch, yaw, from_north=False)


def _pitch_yaw(
    item: MissionItem, before: GimbalTarget, vehicle: MissionVehicle
) -> tuple[GimbalTarget, str]:
    pitch, yaw, pitch_rate, yaw_rate, flags, *_ = item.parameters
    bits = int(flags) if math.isfinite(flags) else 0
    for flag in (mavlink.GIMBAL_MANAGER_FLAGS_RETRACT, mavlink.GIMBAL_MANAGER_FLAGS_NEUTRAL):
        if bits & flag:
            name = mavlink.enums["GIMBAL_MANAGER_FLAGS"][flag].name
            return GimbalTarget(), f"{name}: where the camera looks is not known here"
    if math.isnan(pitch) and math.isnan(yaw):
        turns = any(math.isfinite(rate) and rate != 0 for rate in (pitch_rate, yaw_rate))
        return before, "it turns at a rate, to nobody knows where" if turns else ""
    if vehicle.is_ardupilot and (math.isnan(pitch) or math.isnan(yaw)):
        return before, ""  # AP_Mission takes both angles or none
    locked = bool(bits & mavlink.GIMBAL_MANAGER_FLAGS_YAW_LOCK)
    return _angles(before, pitch, yaw, from_north=locked)


def _angles(
    before: GimbalTarget, pitch: float, yaw: float, *, from_north: bool
) -> tuple[GimbalTarget, str]:
    """The target with these angles (degrees); those that are NaN stay as they were."""
    odd = abs(pitch) > _PITCH_LIMIT_DEG or abs(yaw) > _YAW_LIMIT_DEG
    if odd or math.isinf(pitch) or math.isinf(yaw):
        return GimbalTarget(), f"pitch {pitch:g}, yaw {yaw:g} are no angles in degrees"
    target = replace(before, roi=None)
    if not math.isnan(pitch):
        target = replace(target, pitch_deg=pitch)
    if not math.isnan(yaw):
        target = replace(target, yaw_deg=yaw, from_north=from_north)
    return target, ""
