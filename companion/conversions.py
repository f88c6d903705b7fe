"""Conversions between the types of localizer and bridge; all conversions of the flight are here.

Pure geometry, no threads, no MAVLink.

Axes: the map's ENU; NED at the vehicle; body FRD; gimbal (x along the boresight, y right, z down);
camera OpenCV (x right, y down, z forward). The gimbal's attitude comes from the bridge, which
knows its flags and the camera's mounting on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.geometry import (
    GIMBAL_FROM_CAMERA,
    world_from_camera,
)
from companion.targets.detections import CLICKED
from localizer.geometry.camera import Camera
from localizer.geometry.geo import NED_FROM_ENU, Geodetic, LocalFrame
from localizer.geometry.pose import (
    Array,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from localizer.targets.locate import RayCaster, ray_in_world
from localizer.types import PoseEstimate, PosePrior, TargetFix, Visibility
from mavlink_bridge.messages import (
    Attitude,
    CameraView,
    GimbalAttitude,
    TargetReport,
    VehicleState,
    VisionFix,
)

# An autopilot position older than this does not start tracking.
_MAX_POSITION_AGE_NS = 2_000_000_000


@dataclass(frozen=True)
class CameraExtrinsics:
    """Constants of a flight: map frame, geoid above ellipsoid, lever arm (3,) in body axes."""

    frame: LocalFrame
    geoid_separation_m: float
    lever_arm_m: Array
    """(3,) metres, from the autopilot to the camera, body axes."""


def vision_fix(
    estimate: PoseEstimate,
    extrinsics: CameraExtrinsics,
    attitude: Attitude | None,
    gimbal: GimbalAttitude | None,
    reset_count: int,
) -> VisionFix:
    """The vehicle's position and attitude from the camera's estimate; for accepted estimates.

    attitude, gimbal: at the exposure. Together they give the camera's orientation on the body.
    reset_count: number of jumps so far (`FixInjection`).
    Without them the vehicle's attitude is unknown. The camera's position is then reported as that
    of the vehicle, and the square of the lever arm's length is added to the variance of each axis.
    """
    frame, arm, pose = extrinsics.frame, extrinsics.lever_arm_m, estimate.world_from_camera
    world_from_body: Array | None = None
    body, arm_variance = pose.translation, float(arm @ arm)
    if attitude is not None and gimbal is not None:
        world_from_body = pose.rotation @ camera_on_body(attitude, gimbal).T
        body, arm_variance = body - world_from_body @ arm, 0.0
    position = frame.position(body)
    to_ned = frame.ned_from_enu(position)
    covariance = to_ned @ estimate.covariance[:3, :3] @ to_ned.T + np.eye(3) * arm_variance
    return VisionFix(
        time_ns=estimate.exposure_time_ns,
        latitude_deg=position.latitude_deg,
        longitude_deg=position.longitude_deg,
        height_m=position.height_m,
        quaternion=None if world_from_body is None else _quaternion(to_ned @ world_from_body),
        position_covariance_ned=covariance,
        attitude_sigma_rad=float(np.sqrt(estimate.covariance.diagonal()[3:].max())),
        reset_count=reset_count,
        quality=round(100 * min(max(estimate.quality, 0.0), 1.0)),
        scale_sigma=estimate.scale_sigma,
    )


def _quaternion(rotation: Array) -> tuple[float, float, float, float]:
    w, x, y, z = (float(one) for one in quaternion_from_matrix(rotation))
    return w, x, y, z


def camera_on_body(attitude: Attitude, gimbal: GimbalAttitude) -> Array:
    """Rotation (3, 3) body_from_camera, from both attitudes to NED at the same time."""
    ned_from_camera = matrix_from_quaternion(gimbal.quaternion) @ GIMBAL_FROM_CAMERA
    rotation: Array = matrix_from_quaternion(attitude.quaternion).T @ ned_from_camera
    return rotation


def camera_rotation(gimbal: GimbalAttitude) -> Array:
    """Rotation (3, 3) world_from_camera by the gimbal's report.

    The gimbal reports against north, east and down at the vehicle. The world axes are east, north
    and up at the map's origin. The difference is ignored: 0.1° at 10 km, far below the gimbal's
    error.
    """
    world_from_camera: Array = (
        NED_FROM_ENU.T @ matrix_from_quaternion(gimbal.quaternion) @ GIMBAL_FROM_CAMERA
    )
    return world_from_camera


def vehicle_prior(
    state: VehicleState,
    attitude: Attitude | None,
    gimbal: GimbalAttitude | None,
    extrinsics: CameraExtrinsics,
    sigma: tuple[float, float],
    time_ns: int,
) -> PosePrior | None:
    """The camera's pose and velocity at `time_ns` from the autopilot's data. The newest position is
    carried on by the EKF's velocity. None without attitude, gimbal, or a position within 2 s.
    attitude, gimbal: at that time. sigma: of position (m) and rotation (rad), each per axis.
    """
    age_ns = time_ns - state.position_time_ns
    if attitude is None or gimbal is None or abs(age_ns) > _MAX_POSITION_AGE_NS:
        return None
    place = (state.latitude_deg, state.longitude_deg, state.altitude_amsl_m)
    if place[0] is None or place[1] is None or place[2] is None:
        return None
    frame = extrinsics.frame
    position = Geodetic(place[0], place[1], place[2] + extrinsics.geoid_separation_m)
    body = frame.enu_from_geodetic(position.latitude_deg, position.longitude_deg, position.height_m)
    to_ned = frame.ned_from_enu(position)
    velocity: Array | None = None
    if state.local_velocity_ned is not None:
        velocity = to_ned.T @ np.array(state.local_velocity_ned)
        body = body + velocity * age_ns * 1e-9
    ned_from_body = matrix_from_quaternion(attitude.quaternion)
    ned_from_camera = matrix_from_quaternion(gimbal.quaternion) @ GIMBAL_FROM_CAMERA
    arm = extrinsics.lever_arm_m
    camera = world_from_camera(body, ned_from_body, ned_from_camera, arm, to_ned)
    covariance = np.diag(np.repeat(np.square(sigma), 3))
    return PosePrior(camera, covariance, time_ns, velocity)


def target_report(fix: TargetFix, camera: Camera, frame: LocalFrame, number: int) -> TargetReport:
    """A located target as a report. camera: that of its frame, for its pixel as a share of the
    image. frame: of the map. number: the target's id in MAVLink.
    """
    position = frame.position(fix.position_world)
    velocity_ned = velocity_sigma = None
    if fix.velocity is not None:
        east, north, up = (float(v) for v in fix.velocity)
        velocity_ned = (north, east, -up)
    if fix.velocity_covariance is not None:
        velocity_sigma = float(np.sqrt(np.trace(fix.velocity_covariance[:2, :2])))
    pixel = rectangle = None
    if fix.pixel is not None:
        pixel = (fix.pixel[0] / camera.width, fix.pixel[1] / camera.height)
        if fix.extent is not None:
            w, h = fix.extent[0] / camera.width / 2.0, fix.extent[1] / camera.height / 2.0
            x, y = pixel
            rectangle = (max(x - w, 0.0), max(y - h, 0.0), min(x + w, 1.0), min(y + h, 1.0))
    return TargetReport(
        time_ns=fix.exposure_time_ns,
        latitude_deg=position.latitude_deg,
        longitude_deg=position.longitude_deg,
        height_m=position.height_m,
        velocity_ned=velocity_ned,
        h_accuracy_m=float(np.sqrt(fix.covariance[0, 0] + fix.covariance[1, 1])),
        v_accuracy_m=float(np.sqrt(fix.covariance[2, 2])),
        pixel=pixel,
        target_id=number,
        elsewhere=fix.elsewhere,
        rectangle=rectangle,
        velocity_accuracy_mps=velocity_sigma,
        clicked=fix.target_id.startswith(CLICKED),
        coasting=fix.visibility is Visibility.HIDDEN,
    )


def camera_view(estimate: PoseEstimate, frame: LocalFrame, cast: RayCaster) -> CameraView:
    """The camera's position and direction, and the ground point in the image's centre; that is None
    if its ray does not hit the map. frame: of the map. cast: intersects rays with the map.
    """
    pose, camera = estimate.world_from_camera, estimate.camera
    position = frame.position(pose.translation)
    ned_from_camera = frame.ned_from_enu(position) @ pose.rotation
    eye, direction = ray_in_world(estimate, (camera.width / 2.0, camera.height / 2.0))
    distance = float(cast(eye, direction[None, :]).distances[0])
    seen = frame.position(eye + distance * direction) if math.isfinite(distance) else None
    return CameraView(
        estimate.exposure_time_ns,
        position.latitude_deg,
        position.longitude_deg,
        position.height_m,
        _quaternion(ned_from_camera @ GIMBAL_FROM_CAMERA.T),
        None if seen is None else seen.latitude_deg,
        None if seen is None else seen.longitude_deg,
        None if seen is None else seen.height_m,
        float(np.sqrt(estimate.covariance[0, 0] + estimate.covariance[1, 1])),
        float(np.sqrt(estimate.covariance[2, 2])),
        (camera.horizontal_fov_deg, camera.vertical_fov_deg),
    )
