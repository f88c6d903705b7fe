"""The geometry between a vehicle and its camera, in both directions; no threads, no MAVLink.

Axes: body FRD (x forward, y right, z down); gimbal (x along the boresight, y right, z down); camera
OpenCV (x right, y down, z forward); NED at the vehicle; world = the map's ENU. The simulated camera
and the companion both use this chain, so that a sign is wrong in both or in neither: the tests hold
it to hand-made cases.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from localizer.geometry.geo import BODY_FROM_CAMERA, NED_FROM_ENU
from localizer.geometry.pose import Array, Pose, matrix_from_euler

GIMBAL_FROM_CAMERA = BODY_FROM_CAMERA


class GimbalFrame(Enum):
    """Reference frame of a gimbal's angles.

    HEADING: roll and pitch from the horizon, yaw from the vehicle's heading (MAVLink's
    GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME, as ArduPilot sends it). EARTH: yaw from true north.
    BODY: all three angles from the body, as for a fixed camera.
    """

    HEADING = "heading"
    EARTH = "earth"
    BODY = "body"


@dataclass(frozen=True)
class GimbalAngles:
    """A gimbal's attitude, applied as Rz(yaw) Ry(pitch) Rx(roll); pitch -pi/2 looks down."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    frame: GimbalFrame = GimbalFrame.HEADING


@dataclass(frozen=True)
class Mount:
    """Mounting of the camera on the vehicle.

    rotation: (3, 3), camera housing to gimbal (both x forward, y right, z down), the calibration's
    boresight correction. lever_arm_m: (3,), from the autopilot to the camera, body axes.
    """

    rotation: Array
    lever_arm_m: Array

    @classmethod
    def from_degrees(
        cls,
        roll_deg: float = 0.0,
        pitch_deg: float = 0.0,
        yaw_deg: float = 0.0,
        lever_arm_m: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Mount:
        """From Euler angles in degrees, applied as Rz(yaw) Ry(pitch) Rx(roll), and the lever arm
        (3,), as in a configuration.
        """
        angles = np.radians([roll_deg, pitch_deg, yaw_deg])
        return cls(matrix_from_euler(*angles), np.asarray(lever_arm_m, dtype=np.float64))


def heading(ned_from_body: Array) -> float:
    """Yaw (rad, from true north, clockwise) of a body attitude (3, 3)."""
    return float(np.arctan2(ned_from_body[1, 0], ned_from_body[0, 0]))


def gimbal_attitude(ned_from_body: Array, gimbal: GimbalAngles) -> Array:
    """Rotation (3, 3) NED from gimbal, from the gimbal's reported angles in whichever frame they
    are. ned_from_body: (3, 3), the vehicle's attitude.
    """
    R = matrix_from_euler(gimbal.roll_rad, gimbal.pitch_rad, gimbal.yaw_rad)
    if gimbal.frame is GimbalFrame.EARTH:
        return R
    if gimbal.frame is GimbalFrame.BODY:
        return ned_from_body @ R
    return matrix_from_euler(0.0, 0.0, heading(ned_from_body)) @ R


def camera_attitude(ned_from_body: Array, gimbal: GimbalAngles, mount: Mount) -> Array:
    """Rotation (3, 3) NED from camera (OpenCV axes). ned_from_body: (3, 3)."""
    return gimbal_attitude(ned_from_body, gimbal) @ mount.rotation @ GIMBAL_FROM_CAMERA


def world_from_camera(
    position: ArrayLike,
    ned_from_body: Array,
    ned_from_camera: Array,
    lever_arm_m: ArrayLike,
    ned_from_world: Array = NED_FROM_ENU,
) -> Pose:
    """The camera's pose. position: (3,) of the vehicle, world metres; ned_from_body,
    ned_from_camera: (3, 3) attitudes; lever_arm_m: (3,) autopilot to camera, body axes.

    ned_from_world: `LocalFrame.ned_from_enu`; by default as at the map's origin.
    """
    arm = ned_from_world.T @ ned_from_body @ np.asarray(lever_arm_m, dtype=np.float64)
    centre = np.asarray(position, dtype=np.float64) + arm
    return Pose(ned_from_world.T @ ned_from_camera, centre)
