"""Other sensors' knowledge of the camera pose, as constraints of the registration.

Each function makes a `PoseConstraint`; `combine` adds several; `JNGO.register` takes the result
(docs/explanation/registration.md, section 9). `fuse` applies one to a registered pose afterwards,
weighted by the pose's covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array, Pose, so3_exp, so3_log


@dataclass(frozen=True)
class PoseConstraint:
    """A quadratic cost ``d' L d`` about a pose.

    d: (6,) difference to `world_from_camera` (position, left rotation vector; world axes).
    information: L (6, 6), zero along unknown directions.
    """

    world_from_camera: Pose
    information: Array


def attitude_constraint(
    rotation: Array, tilt_sigma_rad: float, heading_sigma_rad: float
) -> PoseConstraint:
    """A constraint on the camera's rotation (3, 3) world_from_camera, measured by autopilot and
    gimbal.

    tilt_sigma_rad: of roll and pitch, small because of gravity; heading_sigma_rad: about the
    vertical, large because of the compass.
    """
    information = np.zeros((6, 6))
    information[3, 3] = information[4, 4] = tilt_sigma_rad**-2
    information[5, 5] = heading_sigma_rad**-2
    return PoseConstraint(Pose(rotation, np.zeros(3)), information)


def height_constraint(height_m: float, sigma_m: float) -> PoseConstraint:
    """The camera's world z in metres (up from the map's origin), from the barometer or a
    rangefinder above known ground.
    """
    information = np.zeros((6, 6))
    information[2, 2] = sigma_m**-2
    return PoseConstraint(Pose(np.eye(3), np.array([0.0, 0.0, height_m])), information)


def combine(*constraints: PoseConstraint) -> PoseConstraint:
    """One constraint with the sum of the costs, up to a constant.

    Rotations are linearised about the first constraint that knows one.
    """
    rotation = next(
        (c.world_from_camera.rotation for c in constraints if c.information[3:, 3:].any()),
        np.eye(3),
    )
    information, weighted = np.zeros((6, 6)), np.zeros(6)
    for c in constraints:
        turn = np.zeros(3)
        if c.information[3:, 3:].any():
            turn = so3_log(c.world_from_camera.rotation @ rotation.T)
        d = np.concatenate([c.world_from_camera.translation, turn])
        information += c.information
        weighted += c.information @ d
    # Sensors differ by orders of magnitude (m², rad²): scale before the rank decision.
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(scale, scale)
    mean = np.linalg.pinv(scaled, hermitian=True) @ (weighted / scale) / scale
    return PoseConstraint(Pose(so3_exp(mean[3:]) @ rotation, mean[:3]), information)


@dataclass(frozen=True)
class FusedPose:
    """A pose after a constraint was fused. covariance: (6, 6) as `PosePrior`'s; innovation_squared:
    squared Mahalanobis distance of the constraint from the pose before.
    """

    world_from_camera: Pose
    covariance: Array
    innovation_squared: float


def constraint_rows(constraint: PoseConstraint, pose: Pose) -> tuple[Array, Array]:
    """(K, 6) rows F and (K,) values z of unit variance, so that ``F d = z`` for the difference d
    (6,) by which `pose` should move: the constraint, scaled by its own sigmas.
    """
    scale = np.sqrt(np.maximum(np.diag(constraint.information), 1e-300))
    values, vectors = np.linalg.eigh(constraint.information / np.outer(scale, scale))
    known = values > 1e-9
    rows = (np.sqrt(values[known]) * vectors[:, known]).T * scale
    target = constraint.world_from_camera
    turn = np.zeros(3)
    if constraint.information[3:, 3:].any():
        turn = so3_log(target.rotation @ pose.rotation.T)
    difference = np.concatenate([target.translation - pose.translation, turn])
    return rows, rows @ difference


def fuse(pose: Pose, covariance: Array, constraint: PoseConstraint) -> FusedPose:
    """A pose and its covariance (6, 6) after the update with a constraint of another sensor.

    The sensor's error (mounting, gimbal, air pressure) is constant over frames and does not average
    out. So along each principal direction a variance P larger than the sensor's R becomes R, by an
    update with the noise ``R P / (P - R)``; a smaller one is unchanged. `odometry.growth.fuse`
    follows the same rule.
    """
    rows, values = constraint_rows(constraint, pose)
    known = rows @ covariance @ rows.T
    squared = float(values @ np.linalg.solve(known + np.eye(len(rows)), values))
    variance, axes = np.linalg.eigh(known)  # in units of the sensor's own
    heard = variance > 1.0
    if not heard.any():
        return FusedPose(pose, covariance, squared)
    rows, values, variance = (axes.T @ rows)[heard], (axes.T @ values)[heard], variance[heard]
    # The directions are uncorrelated, so P + R P / (P - R) = P² / (P - R) is the spread of each.
    gain = (rows @ covariance).T * ((variance - 1.0) / variance**2)
    step = gain @ values
    after = covariance - gain @ rows @ covariance
    return FusedPose(
        Pose(so3_exp(step[3:]) @ pose.rotation, pose.translation + step[:3]),
        0.5 * (after + after.T),
        squared,
    )
