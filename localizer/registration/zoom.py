"""Whether another focal length fits an image better (docs/explanation/registration.md, section 8b).

A camera that zooms 5 % more than assumed seems 5 % closer: the registration ends metres away with
the same quality, and most parts of the image agree. Depth shows the difference; even over flat
ground seen straight down, a zoom and a shift differ slightly. So the best pose is refined again
under a longer, a shorter and its own focal length. By construction an error of half a step is
tolerated, where two of them fit equally.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from localizer.device_array import DeviceArray
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.registration.backend import (
    Backend,
    LevelProblem,
    camera_from_local,
    level_problems,
    local_origin,
)
from localizer.registration.config import JNGOConfig
from localizer.registration.result import Registration
from localizer.registration.selection import median_residual, subsample_anchors
from localizer.types import Anchors, FeaturePyramid, FocalFit, RegistrationStatus

FOCAL_STEP = 0.05
_FINE_ANCHORS, _ANCHORS = 500, 2000  # of the network's finest level, and of the last
_ITERATIONS = 8  # on either
_LEAST_SCALE = 0.02  # of the loss, where features fit perfectly
# Costs are compared with each other alone: the unit that priors have where features fit perfectly
# (`selection.LEAST_SCORE`) would make a perfect fit look worse than another focal length's.
_NO_COST = 1e-9
FOCAL_REACH = 0.02  # of a fit to either side: a table is not further off
_FINER = 0.006  # its second step
# Of a fit: over the square of the share, of the cost. Below the least a zoom looks like a height;
# above it single pictures were 0.02 over its root off, or less (made places, 0.3 % at 50).
_LEAST_CURVATURE, _SIGMA = 20.0, 0.02


@dataclass(frozen=True)
class FocalTest:
    """Refines a registered pose under other focal lengths, on the registration's own backend."""

    backend: Backend
    config: JNGOConfig

    def gain(
        self, query: FeaturePyramid, camera: Camera, anchors: Anchors, found: Registration
    ) -> float:
        """Relative decrease of a registration's cost with a focal length `FOCAL_STEP` longer or
        shorter, with the pose refined; the larger of both.

        Negative if the camera's own focal length fits best; -inf if it cannot be tested (a
        registration that failed, features on a GPU).
        """
        on_device = any(isinstance(level.features, DeviceArray) for level in query.levels)
        if found.status is not RegistrationStatus.OK or on_device:
            return -np.inf
        problem = self._focal_problem(query, camera, anchors, found.world_from_camera)
        factors = (1.0 - FOCAL_STEP, 1.0, 1.0 + FOCAL_STEP)
        return focal_gain({factor: self._cost(problem, factor) for factor in factors})

    def fit(
        self, query: FeaturePyramid, camera: Camera, anchors: Anchors, found: Registration
    ) -> FocalFit | None:
        """The best focal length, as a multiple of the camera's, with the pose refined for each;
        takes 5 ms. None if the image does not determine it (flat ground seen straight down), if it
        is beyond `FOCAL_REACH`, and where `gain` gives -inf.
        """
        on_device = any(isinstance(level.features, DeviceArray) for level in query.levels)
        if found.status is not RegistrationStatus.OK or on_device:
            return None
        problem = self._focal_problem(query, camera, anchors, found.world_from_camera)
        best, curvature = 1.0, 0.0
        for step in (FOCAL_REACH, _FINER):
            costs = [self._cost(problem, best + k * step) for k in (-1, 0, 1)]
            bend = 0.5 * (costs[0] + costs[2]) - costs[1]
            curvature = bend / (max(costs[1], _NO_COST) * step**2)
            if not np.isfinite(curvature) or curvature < _LEAST_CURVATURE:
                return None
            away = 0.25 * (costs[0] - costs[2]) / bend
            if abs(away) > 1.0:
                return None
            best += step * away
        return FocalFit(best, _SIGMA / float(np.sqrt(curvature)))

    def _focal_problem(
        self, query: FeaturePyramid, camera: Camera, anchors: Anchors, pose: Pose
    ) -> _FocalProblem:
        origin = local_origin(anchors, pose)
        problems = level_problems(query, camera, anchors, origin)
        searched = len(self.config.iterations)
        fine, last = (
            subsample_anchors(problems[searched - 1], _FINE_ANCHORS),
            subsample_anchors(problems[-1], _ANCHORS),
        )
        R, t = camera_from_local(pose.rotation[None], pose.translation[None], origin)
        depth = float((R[0] @ fine.points + t[0][:, None])[2].mean())
        return _FocalProblem((fine, last), R, t, depth)

    def _cost(self, problem: _FocalProblem, factor: float) -> float:
        """Cost on the last level with the focal length multiplied by `factor`."""
        # The camera drawn back as far as the longer focal length seems to bring it on.
        R, t = problem.rotations, problem.translations
        rotations, translations = R, t + np.array([0.0, 0.0, problem.depth_m * (factor - 1.0)])
        score = np.inf
        for level in problem.levels:
            scale = max(median_residual(level, R[0], t[0]), _LEAST_SCALE)
            settings = replace(
                self.config.settings, scale=scale, redescending=True,
                damping=self.config.sharpen_damping,
            )  # fmt: skip
            refined = self.backend.refine(
                _zoomed(level, factor), rotations, translations, _ITERATIONS, settings
            )
            rotations, translations = refined.rotations, refined.translations
            score = float(refined.scores[0])
        return score


@dataclass(frozen=True)
class _FocalProblem:
    """Input of a refinement under several focal lengths: levels, and the registered pose
    camera_from_local, rotations (1, 3, 3) and translations (1, 3).
    """

    levels: tuple[LevelProblem, LevelProblem]
    rotations: Array
    translations: Array
    depth_m: float


def focal_gain(scores: Mapping[float, float]) -> float:
    """Gain of the best other focal length, from costs by factor; -inf without the camera's own."""
    own = scores[1.0]
    if not np.isfinite(own):
        return -np.inf
    best = min(score for factor, score in scores.items() if factor != 1.0)
    return 1.0 - best / max(own, _NO_COST)


def _zoomed(problem: LevelProblem, factor: float) -> LevelProblem:
    fx, fy = problem.focal
    return replace(problem, focal=(fx * factor, fy * factor), prior=None)
