"""Items of a mission, and the camera: https://mavlink.io/en/services/mission.html"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

from pymavlink.dialects.v20 import ardupilotmega as mavlink

# What neither moves the vehicle nor turns or changes its camera.
NO_EFFECT = frozenset(
    (
        mavlink.MAV_CMD_NAV_DELAY,
        mavlink.MAV_CMD_CONDITION_DELAY,
        mavlink.MAV_CMD_CONDITION_DISTANCE,
        mavlink.MAV_CMD_JUMP_TAG,
        mavlink.MAV_CMD_DO_SET_RELAY,
        mavlink.MAV_CMD_DO_REPEAT_RELAY,
        mavlink.MAV_CMD_DO_SET_SERVO,
        mavlink.MAV_CMD_DO_REPEAT_SERVO,
        mavlink.MAV_CMD_DO_SET_ACTUATOR,
        mavlink.MAV_CMD_DO_RETURN_PATH_START,
        mavlink.MAV_CMD_DO_LAND_START,
        mavlink.MAV_CMD_DO_CONTROL_VIDEO,
        mavlink.MAV_CMD_DO_DIGICAM_CONFIGURE,
        mavlink.MAV_CMD_DO_DIGICAM_CONTROL,
        mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST,
        mavlink.MAV_CMD_DO_SET_CAM_TRIGG_INTERVAL,
        mavlink.MAV_CMD_DO_TRIGGER_CONTROL,
        mavlink.MAV_CMD_DO_FENCE_ENABLE,
        mavlink.MAV_CMD_DO_GRIPPER,
        mavlink.MAV_CMD_DO_WINCH,
        mavlink.MAV_CMD_DO_SPRAYER,
        mavlink.MAV_CMD_DO_AUTOTUNE_ENABLE,
        mavlink.MAV_CMD_DO_SET_RESUME_REPEAT_DIST,
        mavlink.MAV_CMD_DO_GUIDED_LIMITS,
        mavlink.MAV_CMD_DO_ENGINE_CONTROL,
        mavlink.MAV_CMD_DO_VTOL_TRANSITION,
        mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE,
        mavlink.MAV_CMD_SET_CAMERA_MODE,
        mavlink.MAV_CMD_SET_CAMERA_FOCUS,
        mavlink.MAV_CMD_SET_STORAGE_USAGE,
        mavlink.MAV_CMD_IMAGE_START_CAPTURE,
        mavlink.MAV_CMD_IMAGE_STOP_CAPTURE,
        mavlink.MAV_CMD_VIDEO_START_CAPTURE,
        mavlink.MAV_CMD_VIDEO_STOP_CAPTURE,
        mavlink.MAV_CMD_VIDEO_START_STREAMING,
        mavlink.MAV_CMD_VIDEO_STOP_STREAMING,
    )
)
# What turns a gimbal in a way that only the flight shows; and what else changes the view so.
GIMBAL_ONLY = frozenset((mavlink.MAV_CMD_DO_MOUNT_CONFIGURE, mavlink.MAV_CMD_DO_MOUNT_CONTROL_QUAT))
VIEW = GIMBAL_ONLY | frozenset(
    (
        mavlink.MAV_CMD_NAV_ROI,
        mavlink.MAV_CMD_CONDITION_YAW,
        mavlink.MAV_CMD_DO_SET_ROI_WPNEXT_OFFSET,
        mavlink.MAV_CMD_DO_SET_ROI_SYSID,
        mavlink.MAV_CMD_SET_CAMERA_ZOOM,
        mavlink.MAV_CMD_SET_CAMERA_SOURCE,
        mavlink.MAV_CMD_CAMERA_TRACK_POINT,
        mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE,
    )
)
# Commands that fly although their numbers are beyond MAV_CMD_NAV_LAST.
FLY_TOO = frozenset(
    (
        mavlink.MAV_CMD_CONDITION_CHANGE_ALT,
        mavlink.MAV_CMD_DO_CHANGE_ALTITUDE,
        mavlink.MAV_CMD_DO_REPOSITION,
        mavlink.MAV_CMD_DO_SET_MODE,
        mavlink.MAV_CMD_DO_GO_AROUND,
        mavlink.MAV_CMD_NAV_SET_YAW_SPEED,
        mavlink.MAV_CMD_NAV_SCRIPT_TIME,
        mavlink.MAV_CMD_NAV_ATTITUDE_TIME,
    )
)


class HeightAbove(Enum):
    """Reference of an item's altitude."""

    HOME = "home"
    SEA = "mean sea level"
    TERRAIN = "terrain"


FRAMES = {
    mavlink.MAV_FRAME_GLOBAL: HeightAbove.SEA,
    mavlink.MAV_FRAME_GLOBAL_INT: HeightAbove.SEA,
    mavlink.MAV_FRAME_MISSION: HeightAbove.SEA,  # as ArduPilot reads it (AP_Mission)
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT: HeightAbove.HOME,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: HeightAbove.HOME,
    mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT: HeightAbove.TERRAIN,
    mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT: HeightAbove.TERRAIN,
}
TAKEOFFS = (mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_NAV_VTOL_TAKEOFF)
LOITERS: Mapping[int, int] = {  # each with the index of its radius
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: 2,
    mavlink.MAV_CMD_NAV_LOITER_TURNS: 2,
    mavlink.MAV_CMD_NAV_LOITER_TIME: 2,
    mavlink.MAV_CMD_NAV_LOITER_TO_ALT: 1,
}
PLACES = (mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT, *LOITERS)
LANDINGS = (mavlink.MAV_CMD_NAV_LAND, mavlink.MAV_CMD_NAV_VTOL_LAND)
DESCENTS = (*LANDINGS, mavlink.MAV_CMD_NAV_PAYLOAD_PLACE)
FLOWN_TO = frozenset((*PLACES, *DESCENTS))  # ArduPilot takes off where it stands
ROI_COMMANDS = (
    mavlink.MAV_CMD_DO_SET_ROI_LOCATION,
    mavlink.MAV_CMD_DO_SET_ROI,
    mavlink.MAV_CMD_DO_SET_ROI_NONE,
)
WITH_PLACE = FLOWN_TO | {*TAKEOFFS, *ROI_COMMANDS}  # their x and y are degrees
_MOST_ROUNDS = 10  # every round is alike
# Without a radius: ArduPlane's WP_LOITER_RAD, PX4's NAV_LOITER_RAD, ArduCopter's CIRCLE_RADIUS.
_WINGED_M, _PX4_M, _COPTER_M = 60.0, 80.0, 10.0
_ARDUPILOT, _PX4 = 3, 12  # MAV_AUTOPILOT
# MAV_TYPE by number: the names of some change from release to release of the dialect.
_MULTIROTORS = frozenset((2, 3, 4, 13, 14, 15, 29, 35, 43))  # helicopters among them
_WINGED = frozenset((1, *range(19, 26)))  # an aeroplane, VTOLs


@dataclass(frozen=True)
class MissionVehicle:
    """Vehicle that a mission is for, as its file states. autopilot: MAV_AUTOPILOT; kind: MAV_TYPE;
    has_rally_points: whether it may return to a rally point instead of home.
    """

    autopilot: int | None = None
    kind: int | None = None
    has_rally_points: bool = False

    @property
    def is_px4(self) -> bool:
        """Whether it is PX4, which interprets some items differently."""
        return self.autopilot == _PX4

    @property
    def is_ardupilot(self) -> bool:
        """Whether it is ArduPilot, any vehicle type."""
        return self.autopilot == _ARDUPILOT

    @property
    def is_multirotor(self) -> bool:
        """Whether the vehicle hovers and has no wings; False if its kind is unknown."""
        return self.kind in _MULTIROTORS

    @property
    def has_wings(self) -> bool:
        """Whether the vehicle is an aeroplane or a VTOL."""
        return self.kind in _WINGED


UNKNOWN_VEHICLE = MissionVehicle()


@dataclass(frozen=True)
class MissionItem:
    """One mission item. number: as used by DO_JUMP, home is 0; command: MAV_CMD; frame: MAV_FRAME;
    parameters: param1 to param7, NaN if not set; latitude and longitude in degrees.
    """

    number: int
    command: int
    frame: int
    parameters: tuple[float, float, float, float, float, float, float]

    @property
    def place(self) -> tuple[float, float] | None:
        """(latitude, longitude), degrees; None if 0, 0 or NaN means the present position."""
        latitude, longitude = self.parameters[4:6]
        unset = (math.isnan(latitude) and math.isnan(longitude)) or (latitude, longitude) == (0, 0)
        return None if unset else (latitude, longitude)

    @property
    def altitude_m(self) -> float | None:
        """Altitude, m; None if 0 or NaN means the present one (ArduCopter's loc_from_cmd)."""
        altitude = self.parameters[6]
        return None if math.isnan(altitude) or altitude == 0 else altitude

    @property
    def label(self) -> str:
        """MAVLink name and number of the item."""
        return f"{command_name(self.command)} (item {self.number})"


@dataclass(frozen=True)
class LoiterCircle:
    """A flown circle. radius_m: negative is counter-clockwise; inward: the nose points to the
    centre.
    """

    radius_m: float
    rounds: int = 1
    inward: bool = False


@dataclass(frozen=True)
class UnreadItem:
    """A complex item, which a ground station expands only on upload. name: as in the file."""

    number: int
    name: str

    @property
    def label(self) -> str:
        """Name and number of the item."""
        return f"{self.name} (item {self.number})"


def command_name(command: int) -> str:
    """MAVLink name of a command number."""
    entry = mavlink.enums["MAV_CMD"].get(command)
    return f"MAV_CMD {command}" if entry is None else str(entry.name)


def circle_of(item: MissionItem, vehicle: MissionVehicle) -> tuple[LoiterCircle | None, list[str]]:
    """The circle of a loiter item, None if the vehicle hovers or flies on; and notes as sentences.

    A multirotor with ArduPilot flies a circle for LOITER_TURNS only; with PX4 it flies none. A
    vehicle of unknown kind is treated as one with wings.
    """
    if item.command not in LOITERS:
        return None, []
    turns = item.command == mavlink.MAV_CMD_NAV_LOITER_TURNS
    if vehicle.is_multirotor and (vehicle.is_px4 or not turns):
        return None, []
    notes, count = [], item.parameters[0]
    radius = item.parameters[LOITERS[item.command]]
    if math.isnan(radius) or radius == 0:
        usual = _PX4_M if vehicle.is_px4 else _WINGED_M
        radius = _COPTER_M if vehicle.is_multirotor else usual
        notes.append(
            f"{item.label} gives no radius: judged on the firmware's default circle of "
            f"{radius:.0f} m."
        )
    rounds = math.ceil(count) if turns and math.isfinite(count) and count > 0 else 1
    if rounds > _MOST_ROUNDS:
        notes.append(f"{item.label}: {_MOST_ROUNDS} of its {rounds} rounds are counted.")
    elif item.command in (mavlink.MAV_CMD_NAV_LOITER_TIME, mavlink.MAV_CMD_NAV_LOITER_UNLIM):
        notes.append(f"{item.label}: one round of its circle is judged, all are equal.")
    return LoiterCircle(radius, min(rounds, _MOST_ROUNDS), vehicle.is_multirotor), notes


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
