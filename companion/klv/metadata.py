"""The ST 0601 fields of one frame, from its pose, the map and the newest target."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.geometry import GIMBAL_FROM_CAMERA
from companion.klv import local_set as tag
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Array, euler_from_matrix
from localizer.targets.locate import RayCaster, ray_in_world
from localizer.types import PoseEstimate, TargetFix

_CE90 = 2.146 / math.sqrt(2.0)  # of a circular error whose sigma is over both directions
_LE90 = 1.645
_OFFSET_DEG = 0.075  # the largest corner offset that tags 26 to 33 hold


@dataclass(frozen=True)
class KlvContext:
    """Constants of a flight for its metadata. cast: intersects rays with the map; geoid_m: geoid
    height above the ellipsoid.
    """

    frame: LocalFrame
    cast: RayCaster
    geoid_m: float
    mission: str = ""
    source: str = "EO"


def frame_fields(
    estimate: PoseEstimate,
    scene: KlvContext,
    ned_from_body: Array | None = None,
    target: TargetFix | None = None,
) -> dict[int, float | str]:
    """ST 0601 fields of an accepted estimate's frame.

    ned_from_body: (3, 3), the aircraft's attitude. If it is None, the angles of the aircraft and of
    the camera relative to it are left out. Without map at the image's centre, centre and corners
    are left out; without map at one corner, all corners. target: to be described with the frame.
    """
    pose, camera = estimate.world_from_camera, estimate.camera
    position = scene.frame.position(pose.translation)
    fields: dict[int, float | str] = {
        tag.IMAGE_SOURCE: scene.source,
        tag.COORDINATES: "WGS-84",
        tag.SENSOR_LATITUDE: position.latitude_deg,
        tag.SENSOR_LONGITUDE: position.longitude_deg,
        tag.SENSOR_ALTITUDE: position.height_m - scene.geoid_m,
        tag.SENSOR_HEIGHT: position.height_m,
        tag.HORIZONTAL_FOV: camera.horizontal_fov_deg,
        tag.VERTICAL_FOV: math.degrees(2.0 * math.atan(0.5 * camera.height / camera.fy)),
    }
    if scene.mission:
        fields[tag.MISSION] = scene.mission
    if ned_from_body is not None:
        ned_from_camera = scene.frame.ned_from_enu(position) @ pose.rotation
        fields |= _attitude(ned_from_body, ned_from_camera)
    fields |= _footprint(estimate, scene)
    if target is not None:
        fields |= _target(target, scene)
    return fields


def _attitude(ned_from_body: Array, ned_from_camera: Array) -> dict[int, float | str]:
    """The aircraft's angles, and the camera's relative to it: azimuth, elevation, roll in this
    order.
    """
    roll, pitch, yaw = (math.degrees(a) for a in euler_from_matrix(ned_from_body))
    on_body = ned_from_body.T @ ned_from_camera @ GIMBAL_FROM_CAMERA.T
    turn, elevation, azimuth = (math.degrees(a) for a in euler_from_matrix(on_body))
    fields: dict[int, float | str] = {
        tag.PLATFORM_HEADING: yaw % 360.0,
        tag.RELATIVE_AZIMUTH: azimuth % 360.0,
        tag.RELATIVE_ELEVATION: elevation,
        tag.RELATIVE_ROLL: turn % 360.0,
    }
    steep = abs(pitch) > 20.0 or abs(roll) > 50.0
    fields[tag.PLATFORM_PITCH_FULL if steep else tag.PLATFORM_PITCH] = pitch
    fields[tag.PLATFORM_ROLL_FULL if steep else tag.PLATFORM_ROLL] = roll
    return fields


def _footprint(estimate: PoseEstimate, scene: KlvContext) -> dict[int, float | str]:
    """The image's centre on the ground with its distance, and the corners (left above, right above,
    right below, left below).
    """
    w, h = float(estimate.camera.width), float(estimate.camera.height)
    centre, distance = _seen(estimate, (w / 2.0, h / 2.0), scene)
    if centre is None:
        return {}
    fields: dict[int, float | str] = {
        tag.SLANT_RANGE: distance,
        tag.CENTRE_LATITUDE: centre.latitude_deg,
        tag.CENTRE_LONGITUDE: centre.longitude_deg,
        tag.CENTRE_ELEVATION: centre.height_m - scene.geoid_m,
        tag.CENTRE_HEIGHT: centre.height_m,
    }
    corners = []
    for pixel in ((0.0, 0.0), (w, 0.0), (w, h), (0.0, h)):
        corner, _ = _seen(estimate, pixel, scene)
        if corner is None:
            return fields
        corners += [corner.latitude_deg, corner.longitude_deg]
    own = (centre.latitude_deg, centre.longitude_deg)
    offsets = [value - own[k % 2] for k, value in enumerate(corners)]
    if all(abs(offset) <= _OFFSET_DEG for offset in offsets):
        return fields | dict(enumerate(offsets, tag.FIRST_CORNER_OFFSET))
    return fields | dict(enumerate(corners, tag.FIRST_CORNER))


def _seen(
    estimate: PoseEstimate, pixel: tuple[float, float], scene: KlvContext
) -> tuple[Geodetic | None, float]:
    eye, direction = ray_in_world(estimate, pixel)
    distance = float(scene.cast(eye, direction[None]).distances[0])
    if not math.isfinite(distance):
        return None, math.nan
    return scene.frame.position(eye + distance * direction), distance


def _target(target: TargetFix, scene: KlvContext) -> dict[int, float | str]:
    place = scene.frame.position(target.position_world)
    P = target.covariance
    return {
        tag.TARGET_LATITUDE: place.latitude_deg,
        tag.TARGET_LONGITUDE: place.longitude_deg,
        tag.TARGET_ELEVATION: place.height_m - scene.geoid_m,
        tag.TARGET_CE90: _CE90 * float(np.sqrt(P[0, 0] + P[1, 1])),
        tag.TARGET_LE90: _LE90 * float(np.sqrt(P[2, 2])),
    }
