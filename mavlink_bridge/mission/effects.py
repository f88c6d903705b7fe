"""Classifies mission commands: they change the path, the camera, or neither. Others are unknown."""

from __future__ import annotations

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
