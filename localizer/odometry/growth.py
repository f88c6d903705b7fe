"""How the odometry's error grows: keyframe by keyframe, with the way, and while nothing is seen."""

from __future__ import annotations

import numpy as np

from localizer.geometry.pose import Array, Pose, hat, quaternion_from_matrix, so3_exp, so3_log
from localizer.odometry.config import GrowthModel
from localizer.registration.priors import PoseConstraint
from localizer.types import PosePrior


def carried(covariance: Array, lever: Array) -> Array:
    """Covariance (6, 6) of a pose that is known exactly relative to another one of `covariance`.

    lever: (3,) position relative to the other's, world axes. A small turn of the other one moves
    this one by ``turn x lever``.
    """
    J = np.eye(6)
    J[:3, 3:] = -hat(lever)
    moved: Array = J @ covariance @ J.T
    return moved


def walked(model: GrowthModel, way_m: float) -> Array:
    """Covariance (6, 6) that `way_m` metres add, beside the registrations' own."""
    rates = np.array([model.horizontal, model.horizontal, model.vertical,
                      model.tilt, model.tilt, model.heading])  # fmt: skip
    return np.diag(rates**2 * max(way_m, 0.0))


def scaled(model: GrowthModel, displacement: Array) -> Array:
    """Covariance (6, 6) of an error of scale that is the same all along a displacement (3,)."""
    added = np.zeros((6, 6))
    added[:3, :3] = model.scale**2 * np.outer(displacement, displacement)
    return added


def fused(pose: Pose, covariance: Array, constraint: PoseConstraint | None) -> tuple[Pose, Array]:
    """The pose after another sensor's word on it (height, roll and pitch, heading).

    Such a sensor's error stays from frame to frame, so it must not average out: no variance sinks
    below the sensor's own by its use.
    """
    if constraint is None:
        return pose, covariance
    information = constraint.information
    known = np.flatnonzero(np.diag(information) > 0)
    if not len(known):
        return pose, covariance
    target = constraint.world_from_camera
    difference = np.zeros(6)
    if information[:3, :3].any():
        difference[:3] = target.translation - pose.translation
    if information[3:, 3:].any():
        difference[3:] = _tilt_and_heading(target.rotation @ pose.rotation.T)
    noise = np.linalg.inv(information[np.ix_(known, known)])
    gain = covariance[:, known] @ np.linalg.inv(covariance[np.ix_(known, known)] + noise)
    step = gain @ difference[known]
    after = covariance - gain @ covariance[known]
    floor = np.minimum(np.diag(covariance)[known], np.diag(noise))
    lifted = np.zeros(6)
    lifted[known] = np.maximum(floor - np.diag(after)[known], 0.0)
    after = 0.5 * (after + after.T) + np.diag(lifted)
    return Pose(so3_exp(step[3:]) @ pose.rotation, pose.translation + step[:3]), after


def distance_squared(prior: PosePrior, pose: Pose, covariance: Array) -> float:
    """Squared Mahalanobis distance of a pose of `covariance` (6, 6) from a prior, 6 dof."""
    known = prior.world_from_camera
    difference = np.concatenate(
        [pose.translation - known.translation, so3_log(pose.rotation @ known.rotation.T)]
    )
    return float(difference @ np.linalg.solve(prior.covariance + covariance, difference))


def _tilt_and_heading(turn: Array) -> Array:
    """A turn (3, 3) as a small rotation vector (x, y) followed by one about the vertical (z).

    A compass may be far off: the difference in tilt must not be told in its axes.
    """
    w, _, _, z = quaternion_from_matrix(turn)
    heading = np.array([0.0, 0.0, 2.0 * np.arctan2(z, w)])
    tilt = so3_log(so3_exp(heading).T @ turn)
    return np.array([tilt[0], tilt[1], heading[2]])
