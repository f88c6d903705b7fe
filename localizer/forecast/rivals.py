"""Finds other positions at which the map looks similar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array, Pose
from localizer.registration.backend import LevelProblem, camera_from_local, world_from_camera
from localizer.registration.covariance import image_gap_px, mean_motion, pose_differences
from localizer.registration.cpu.reference import in_view, project, projection_jacobian
from localizer.registration.jngo import JNGO
from localizer.registration.selection import quality, subsample_anchors

_RINGS = (0.08, 0.16, 0.3, 0.45)  # of the ground's width in view
_BEARINGS = 12
_ITERATIONS = (3, 3)  # Levenberg-Marquardt steps on the coarsest and on the finest network level
_ANCHORS = 250


@dataclass(frozen=True)
class AmbiguousPosition:
    """The most similar other position. share: its match divided by the true one's, 0 (chance) to 1
    (equal); distance_m: its distance, 0 without one.
    """

    share: float
    distance_m: float


def most_similar_rival(
    optimizer: JNGO, levels: tuple[LevelProblem, ...], origin: Array, truth: Pose, width_m: float
) -> AmbiguousPosition:
    """The other position that matches the view best: poses on rings about the true one are refined,
    and the best optimum away from it is taken.

    levels: the query's levels, coarse to fine; origin: (3,) origin of their local frame; width_m:
    width of the ground in view.
    """
    angles = np.arange(_BEARINGS) * 2 * np.pi / _BEARINGS
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(_BEARINGS)], axis=1)
    steps = np.concatenate([factor * width_m * ring for factor in _RINGS])
    R, t = camera_from_local(
        np.repeat(truth.rotation[None], len(steps), axis=0), truth.translation + steps, origin
    )
    settings = optimizer.config.settings
    for level, iterations in zip((levels[0], levels[-1]), _ITERATIONS, strict=True):
        found = optimizer.backend.refine(
            subsample_anchors(level, _ANCHORS), R, t, iterations, settings
        )
        R, t = found.rotations, found.translations
    rotation, translation = camera_from_local(truth.rotation[None], truth.translation[None], origin)
    here, there = rotation[0], translation[0]
    fine = levels[-1]
    differences = pose_differences(*world_from_camera(R, t, origin), truth)
    apart = image_gap_px(
        differences, here, there, _motion(subsample_anchors(fine, _ANCHORS), here, there)
    )
    scores = np.where(apart > optimizer.config.mode_px, found.scores, np.inf)
    best = int(np.argmin(scores))
    own = quality(fine, here, there, settings)
    if not np.isfinite(scores[best]) or own <= 0:
        return AmbiguousPosition(0.0, 0.0)
    other = quality(fine, R[best], t[best], settings)
    return AmbiguousPosition(min(other / own, 1.0), float(np.linalg.norm(differences[best, :3])))


def _motion(problem: LevelProblem, rotation: Array, translation: Array) -> Array:
    """(6, 6) of `CovarianceSums.motion` at a pose."""
    x, uv = project(problem, rotation, translation)
    seen = in_view(problem, x, uv)
    return mean_motion(projection_jacobian(problem, x[seen], translation))
