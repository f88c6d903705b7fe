"""Pose uncertainty from errors of camera model and map survey.

The residuals do not show them: a principal point error of a pixel leaves them unchanged and moves
the position by a quarter of a metre at 120 m, in every frame.
"""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, scaled_inverse
from localizer.geometry.shutter import Sweep
from localizer.sensors.error_model import SENSORS

_POINTS = 400  # enough for a mean


class CalibrationSigmas(BaseModel):
    """One sigma of each camera parameter after calibration, and of the map's surface."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    focal_percent: float = Field(0.1, ge=0, le=20, description="of the focal length")
    principal_percent: float = Field(
        0.11, ge=0, le=20, description="of the principal point, per axis, % of the image width"
    )
    distortion: float = Field(0.003, ge=0, le=1, description="of k1; k2 as much, p1, p2 a tenth")
    readout_ms: float = Field(1.0, ge=0, le=100, description="of a rolling shutter's readout")
    stamp_ms: float = Field(4.0, ge=0, le=1000, description="of the frames' timestamps")
    map_m: float = Field(SENSORS.map_patch_m, exclude=True)  # of the map's surface, per axis
    map_length_m: float = Field(
        SENSORS.map_patch_length_m, exclude=True
    )  # correlation length of that displacement

    @classmethod
    def none(cls) -> CalibrationSigmas:
        """Sigmas of a camera and a map without errors."""
        return cls(
            focal_percent=0, principal_percent=0, distortion=0, readout_ms=0, stamp_ms=0, map_m=0
        )  # fmt: skip


def calibration_covariance(
    sigmas: CalibrationSigmas, points_world: Array, pose: Pose, camera: Camera,
    sweep: Sweep | None, moving: tuple[Array, Array],
) -> Array:  # fmt: skip
    """Covariance (6, 6), as `PosePrior`'s, of a registered pose from camera and map errors.

    An error of one sigma in a camera parameter moves the pixel of every point by c. The pose
    changes by the least-squares solution over the points in view, ``(sum J'J)^-1 sum J'c``. The
    parameters' errors are independent. A late timestamp moves the pose along its motion. Patches of
    the map are displaced independently.

    With fewer than 6 points in view, or points that determine no pose, only the timestamp counts.

    points_world: (N, 3), the registered points. camera: the pinhole of the registration; sweep: see
    `Sweep`, with the readout of `camera`; moving: velocity (3,), m/s, and angular rate (3,), rad/s,
    world axes.
    """
    stamped = 1e-3 * sigmas.stamp_ms * np.concatenate(moving)
    late = np.outer(stamped, stamped)
    step = max(1, len(points_world) // _POINTS)
    points = points_world[::step]
    pixels, inside = camera.project(pose.inverse.apply(points))
    points, pixels = points[inside], pixels[inside]
    if len(points) < 6:
        return late
    J = _pixel_motion(points, pose, camera)
    shifts = _pixel_shifts(sigmas, points, pixels, pose, camera, sweep)
    rows = J.reshape(-1, 6)
    if (inverse := scaled_inverse(rows.T @ rows)) is None:
        return late
    effects = inverse @ (rows.T @ shifts.reshape(len(rows), -1))
    displaced = inverse @ _displacement(sigmas, J, camera) @ inverse
    covariance: Array = effects @ effects.T + displaced + late
    return covariance


def _displacement(sigmas: CalibrationSigmas, J: Array, camera: Camera) -> Array:
    """(6, 6): variance of ``sum J'c`` for a surface that is displaced patch by patch.

    J: (N, 2, 6) of `_pixel_motion`, spread evenly over the image. A patch is a square of
    `map_length_m` on the ground, whose points have the same displacement.
    """
    by_place = J[:, :, :3]
    px_per_m2 = 0.5 * np.einsum("nai,nai->n", by_place, by_place)
    ground_m2 = camera.width * camera.height / len(J) * float((1.0 / px_per_m2).sum())
    in_patch = len(J) * min(sigmas.map_length_m**2 / max(ground_m2, 1e-9), 1.0)
    pulls = (J.transpose(0, 2, 1) @ by_place).transpose(1, 0, 2).reshape(6, -1)
    spread: Array = pulls @ pulls.T
    return sigmas.map_m**2 * in_patch * spread


def _pixel_motion(points: Array, pose: Pose, camera: Camera) -> Array:
    """(N, 2, 6): pixels by the camera's position and left rotation vector, world axes."""
    R, away = pose.rotation, points - pose.translation
    x, y, z = (away @ R).T
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    in_world = (by_point.reshape(-1, 3) @ R.T).reshape(-1, 2, 3)
    (a, b, c), (p, q, r) = np.moveaxis(in_world, 2, 0), away.T[:, :, None]
    # row' (away x turn) = (row x away)' turn; np.cross costs several times as much
    turned = np.stack([b * r - c * q, c * p - a * r, a * q - b * p], axis=2)
    return np.concatenate([-in_world, turned], axis=2)


def _pixel_shifts(
    sigmas: CalibrationSigmas, points: Array, pixels: Array, pose: Pose, camera: Camera,
    sweep: Sweep | None,
) -> Array:  # fmt: skip
    """(N, 2, K) shifts of the points' pixels by an error of one sigma in each of K parameters."""
    f = np.array([camera.fx, camera.fy])
    x, y = ((pixels - (camera.cx, camera.cy)) / f).T
    r2, none = x * x + y * y, np.zeros(len(points))
    centre = 0.01 * sigmas.principal_percent * camera.width
    focal, radial = 0.01 * sigmas.focal_percent, sigmas.distortion
    tangential = 0.1 * radial
    columns = [
        np.stack([none + centre, none], axis=1),
        np.stack([none, none + centre], axis=1),
        focal * f * np.stack([x, y], axis=1),
        radial * f * np.stack([x * r2, y * r2], axis=1),
        radial * f * np.stack([x * r2 * r2, y * r2 * r2], axis=1),
        tangential * f * np.stack([2 * x * y, r2 + 2 * y * y], axis=1),
        tangential * f * np.stack([r2 + 2 * x * x, 2 * x * y], axis=1),
    ]
    if sweep is not None and camera.readout_ms > 0:
        swept, _ = camera.project(pose.inverse.apply(sweep.apparent_points(points, pose, camera)))
        columns.append((swept - pixels) * (sigmas.readout_ms / camera.readout_ms))
    shifts: Array = np.nan_to_num(np.stack(columns, axis=2))
    return shifts
