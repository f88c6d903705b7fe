"""Converts between the angle conventions of camera poses (docs/reference/angles.md).

Common form: NED from camera (3, 3), OpenCV axes, at the camera's position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.geometry import (
    GIMBAL_FROM_CAMERA,
    GimbalAngles,
    GimbalFrame,
    Mount,
    camera_attitude,
    world_from_camera,
)
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Array, Pose, euler_from_matrix, matrix_from_euler

_LOCKED = 1e-9  # cosine of a pitch at which roll and yaw turn about the same axis


Degrees = tuple[float, float, float]
"""Euler angles (roll, pitch, yaw), Rz(yaw) Ry(pitch) Rx(roll), of a body in NED or of a gimbal."""


@dataclass(frozen=True)
class AutopilotAngles:
    """Pose of a camera as an autopilot reports it: its position, the body's attitude (FRD to NED),
    and the gimbal's (relative to `gimbal_frame`).
    """

    name: str
    time_ns: int | None
    position: Geodetic
    body_deg: Degrees
    gimbal_deg: Degrees
    gimbal_frame: GimbalFrame = GimbalFrame.HEADING


def pose_of_autopilot(angles: AutopilotAngles, frame: LocalFrame) -> Pose:
    """The camera's pose in the map. The position is taken as the camera's: no lever arm."""
    p = angles.position
    body = matrix_from_euler(*np.radians(angles.body_deg))
    roll, pitch, yaw = map(math.radians, angles.gimbal_deg)
    gimbal = GimbalAngles(roll, pitch, yaw, angles.gimbal_frame)
    return world_from_camera(
        frame.enu_from_geodetic(p.latitude_deg, p.longitude_deg, p.height_m),
        body,
        camera_attitude(body, gimbal, Mount.from_degrees()),
        np.zeros(3),
        frame.ned_from_enu(p),
    )


def autopilot_of_pose(
    name: str, time_ns: int | None, pose: Pose, frame: LocalFrame
) -> AutopilotAngles:
    """Angles of a vehicle with this view: level, heading as the camera, roll and pitch by the
    gimbal.

    A camera's pose alone does not determine the vehicle's attitude.
    """
    position = frame.position(pose.translation)
    roll, pitch, yaw = gimbal_of_pose(pose, frame)
    return AutopilotAngles(name, time_ns, position, (0.0, 0.0, yaw), (roll, pitch, 0.0))


def gimbal_of_pose(pose: Pose, frame: LocalFrame) -> Degrees:
    """Gimbal angles of a pose relative to north and the horizon, as in DJI's XMP."""
    to_ned = frame.ned_from_enu(frame.position(pose.translation))
    return angles_of_matrix(to_ned @ pose.rotation @ GIMBAL_FROM_CAMERA.T)


def angles_of_matrix(R: Array) -> Degrees:
    """Euler angles of a rotation (3, 3). At pitch -90 or 90 roll and yaw merge: roll is 0."""
    if np.hypot(R[0, 0], R[1, 0]) < _LOCKED:
        pitch = float(np.copysign(np.pi / 2, -R[2, 0]))
        roll, yaw = 0.0, float(np.arctan2(-R[0, 1], R[1, 1]))
    else:
        roll, pitch, yaw = euler_from_matrix(R)
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)
