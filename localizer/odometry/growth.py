"""Growth of the odometry's error: with keyframes, with distance, and during frames
without texture.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from localizer.geometry.pose import Array, Pose, hat, quaternion_from_matrix, so3_exp, so3_log
from localizer.odometry.config import GrowthModel
from localizer.registration.priors import PoseConstraint


def transferred(covariance: Array, lever: Array) -> Array:
    """Covariance (6, 6) of a pose that is known exactly relative to another with `covariance`.

    lever: (3,) position relative to the other's, world axes. A small rotation of the other pose
    moves this one by ``turn x lever``.
    """
    J = np.eye(6)
    J[:3, 3:] = -hat(lever)
    moved: Array = J @ covariance @ J.T
    return moved


def distance_covariance(model: GrowthModel, way_m: float) -> Array:
    """Covariance (6, 6) that `way_m` metres of flight add beyond the registrations'."""
    rates = np.array([model.horizontal, model.horizontal, model.vertical,
                      model.tilt, model.tilt, model.heading])  # fmt: skip
    return np.diag(rates**2 * max(way_m, 0.0))


def add_scale_error(known: Array, scale: float, displacement: Array) -> Array:
    """Covariance (3, 3) of position from scale errors, after another displacement (3,), m. known:
    the covariance before it. scale: relative sigma.

    The correlation between the scale errors of two displacements is unknown, so the sum is bounded
    for any correlation (covariance intersection). It is exact for one scale along a straight line.
    """
    added = scale * displacement
    before, size = float(np.sqrt(np.trace(known))), float(np.linalg.norm(added))
    if before * size == 0.0:
        return known + np.outer(added, added)
    share = size / before
    total: Array = (1.0 + share) * known + (1.0 + 1.0 / share) * np.outer(added, added)
    return total


def fuse(pose: Pose, covariance: Array, constraint: PoseConstraint | None) -> tuple[Pose, Array]:
    """The pose after another sensor's measurement (height, roll and pitch, heading), axis by axis;
    unchanged without one (None).

    The sensor's error is constant over frames and does not average out. So a variance P larger than
    the sensor's R becomes R, however often it is measured, by an update with the noise ``R P / (P -
    R)``; a smaller one is unchanged.
    """
    if constraint is None:
        return pose, covariance
    information = np.diag(constraint.information)
    target, step = constraint.world_from_camera, np.zeros(6)
    difference = np.zeros(6)
    difference[:3] = target.translation - pose.translation
    if information[3:].any():
        difference[3:] = tilt_and_heading(target.rotation @ pose.rotation.T)
    for axis in np.flatnonzero(information > 0):
        known, own = covariance[axis, axis], 1.0 / information[axis]
        if known <= own:
            continue
        gain = covariance[:, axis] / known * (1.0 - own / known)
        step = step + gain * (difference[axis] - step[axis])
        covariance = covariance - np.outer(gain, covariance[axis])
        covariance = 0.5 * (covariance + covariance.T)
    return Pose(so3_exp(step[3:]) @ pose.rotation, pose.translation + step[:3]), covariance


def kalman_update(pose: Pose, covariance: Array, constraint: PoseConstraint) -> tuple[Pose, Array]:
    """The pose and its covariance (6, 6) after an independent measurement of single axes (those
    with information in `constraint`): a Kalman update.

    Correlated axes are corrected, too: a better rotation also corrects the position. covariance:
    (6, 6) of the pose before.
    """
    information = np.diag(constraint.information)
    known = np.flatnonzero(information > 0)
    target = constraint.world_from_camera
    difference = np.concatenate(
        [target.translation - pose.translation, tilt_and_heading(target.rotation @ pose.rotation.T)]
    )[known]
    noise = np.diag(1.0 / information[known])
    gain = covariance[:, known] @ np.linalg.inv(covariance[np.ix_(known, known)] + noise)
    step = gain @ difference
    after = covariance - gain @ covariance[known]
    moved = Pose(so3_exp(step[3:]) @ pose.rotation, pose.translation + step[:3])
    return moved, 0.5 * (after + after.T)


def between(
    then: PoseConstraint, now: PoseConstraint, pose: Pose, turn_sigma: Array, rise_sigma: float
) -> PoseConstraint | None:
    """Constraint on a later pose from the change between two sensor constraints.

    then, now: the sensors at both times; pose: at `then`, taken as exact. turn_sigma: (3,) rad,
    rise_sigma: m, of the change. None if both constraints have no component in common.
    """
    information, rotation, height = np.zeros(6), pose.rotation, pose.translation[2]
    if _knows_rotation(then) and _knows_rotation(now):
        information[3:] = turn_sigma**-2
        before = then.world_from_camera.rotation
        rotation = now.world_from_camera.rotation @ before.T @ pose.rotation
    if knows_height(then) and knows_height(now):
        information[2] = rise_sigma**-2
        rise = now.world_from_camera.translation[2] - then.world_from_camera.translation[2]
        height = height + rise
    if not information.any():
        return None
    return PoseConstraint(Pose(rotation, np.array([0.0, 0.0, height])), np.diag(information))


def _knows_rotation(constraint: PoseConstraint) -> bool:
    return bool(np.diag(constraint.information)[3:].all())


def without_constant_error(
    constraint: PoseConstraint, then: PoseConstraint, pose: Pose
) -> PoseConstraint:
    """A constraint corrected by the error that the same sensor had at constraint `then`, where the
    true pose was `pose`.

    It corrects the height, the heading about the vertical (compass), and the rest of the rotation
    in the camera's axes (mounting of autopilot and gimbal).
    """
    now, before = constraint.world_from_camera, then.world_from_camera
    rotation, translation = now.rotation, now.translation
    if knows_height(then) and knows_height(constraint):
        offset = pose.translation[2] - before.translation[2]
        translation = translation + np.array([0.0, 0.0, offset])
    if then.information[3:, 3:].any() and constraint.information[3:, 3:].any():
        heading = tilt_and_heading(pose.rotation @ before.rotation.T)[2]
        turn = so3_exp([0.0, 0.0, heading])
        mounting = (turn @ before.rotation).T @ pose.rotation
        rotation = turn @ rotation @ mounting
    return replace(constraint, world_from_camera=Pose(rotation, translation))


def knows_height(constraint: PoseConstraint) -> bool:
    """Whether it constrains the height and not the horizontal position."""
    information = np.diag(constraint.information)
    return bool(information[2] > 0 and not information[:2].any())


def tilt_and_heading(turn: Array) -> Array:
    """Split a rotation (3, 3) into (3,) rad: a small rotation vector's x and y, and the angle about
    the vertical.

    The heading error of a compass may be large, so the tilt difference is computed without it.
    """
    w, _, _, z = quaternion_from_matrix(turn)
    heading = np.array([0.0, 0.0, 2.0 * np.arctan2(z, w)])
    tilt = so3_log(so3_exp(heading).T @ turn)
    return np.array([tilt[0], tilt[1], heading[2]])
