"""Measures a keyframe's position on the map's shape by the image motion after it.

If a keyframe's pose is off, its image lies over the wrong parts of the map's geometry. A later
image then moves over it as the true shape does, not as the map's: roofs slide against streets, and
a tilted image shears. The pose with which both agree best is a measurement of the keyframe that
does not use the map's imagery and does not drift (odometry.md).

The cost is no sum of squares that can be linearised: its information lies at the edges of roofs. So
it is sampled about the pose within its uncertainty, and a quadratic is fitted.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.odometry.keyframe import in_view
from localizer.registration.anchors import anchors_at
from localizer.registration.backend import (
    Backend,
    LMSettings,
    camera_from_local,
    level_problems,
    local_origin,
    world_from_camera,
)
from localizer.registration.selection import median_residual
from localizer.types import FeatureLevel, FeaturePyramid

_BLUR_PX = 1.5  # of the finest level, so that the cost is smooth over the points' pixel fractions
_POINTS = 1500
_STEPS = 3  # of Levenberg-Marquardt for the second picture, under each pose of the first
_REACH = 2.0  # sigmas of the prior at which the cost is sampled
_CROSS = 0.7  # of it, for two axes at once
_DAMPING, _LEAST_OVERLAP, _LEAST_SCALE = 0.003, 0.2, 0.02
_RADIAN_M = 100.0  # weighs turns against shifts where the axes of a covariance are reported


@dataclass(frozen=True)
class ParallaxView:
    """An image's features, its pose world_from_camera, and its pinhole."""

    features: FeaturePyramid
    pose: Pose
    camera: Camera


@dataclass(frozen=True)
class ParallaxAlignment:
    """Poses of two frames on the map's shape; covariance: (6, 6) of the first's."""

    first: Pose
    second: Pose
    covariance: Array


def align(
    backend: Backend, first: ParallaxView, second: ParallaxView, points: Array, prior: Array,
    noise: float,
) -> ParallaxAlignment | None:  # fmt: skip
    """Estimate both frames' poses on surface points (N, 3) of the map; None if they cannot be
    determined.

    second: registered against the first. Both move as one rigid body, apart from the effect of the
    map's shape. prior: (6, 6) covariance of the first's pose. noise: relative sigma of a sample of
    the cost. It takes 29 evaluations of the cost at 1,500 points.
    """
    cost = _Cost(backend, first, second, points)
    axes = _axes(prior)
    plan, design, pairs = _plan(len(axes))
    samples = np.array([cost(step @ axes)[0] for step in plan])
    if not np.isfinite(samples).all():
        return None
    fit = np.linalg.pinv(design)
    told = fit @ (samples / np.median(samples))
    gradient, H = told[1:7], np.zeros((6, 6))
    for (i, j), value in zip(pairs, told[7:], strict=True):
        H[i, j] = H[j, i] = 2.0 * value if i == j else value
    values, vectors = np.linalg.eigh(H)
    H = (vectors * np.maximum(values, 0.0)) @ vectors.T
    W = np.linalg.inv(noise**2 * (fit @ fit.T)[1:7, 1:7])  # of the gradient that was fitted
    C = np.linalg.inv(H @ W @ H + _REACH**2 * np.eye(6))
    step = -(C @ H @ W @ gradient) @ axes
    score, moved = cost(step)
    if not np.isfinite(score):
        return None
    return ParallaxAlignment(_moved(first.pose, step), moved, axes.T @ C @ axes)


def _axes(prior: Array) -> Array:
    """Principal axes of the covariance (6, 6), one a row, each `_REACH` sigmas long."""
    scale = np.repeat([1.0, _RADIAN_M], 3)
    values, vectors = np.linalg.eigh(prior * np.outer(scale, scale))
    axes: Array = _REACH * (vectors * np.sqrt(np.maximum(values, 0.0))).T / scale
    return axes


def _plan(n: int) -> tuple[Array, Array, list[tuple[int, int]]]:
    """Sample points of the cost (M, n), the quadratic's terms there, and its pairs of axes."""
    steps = [np.zeros(n), *np.eye(n), *-np.eye(n)]
    for i, j in itertools.combinations(range(n), 2):
        sign = 1.0 if (i + j) % 2 else -1.0
        steps.append(_CROSS * (np.eye(n)[i] + sign * np.eye(n)[j]))
    plan = np.array(steps)
    pairs = [(i, j) for i in range(n) for j in range(i + 1)]
    squares = [plan[:, i] * plan[:, j] for i, j in pairs]
    return plan, np.column_stack([np.ones(len(plan)), plan, *squares]), pairs


def _moved(pose: Pose, step: Array) -> Pose:
    return Pose(so3_exp(step[3:]) @ pose.rotation, pose.translation + step[:3])


class _Cost:
    """Misfit of the second frame with the first, laid on the map's shape from another pose."""

    def __init__(
        self, backend: Backend, first: ParallaxView, second: ParallaxView, points: Array
    ) -> None:
        self._backend, self._cameras = backend, (first.camera, second.camera)
        self._first, self._second = first.pose, second.pose
        self._features = [_finest(view.features) for view in (first, second)]
        stride = max(1, -(-len(points) // _POINTS))
        self._points = points[::stride]
        self._scale: float | None = None

    def __call__(self, step: Array) -> tuple[float, Pose]:
        """The cost (inf if too little is in view), and the second pose that gives it.

        step: (6,) change of the first pose; the second starts at its pose in the same rigid motion.
        """
        first = _moved(self._first, step)
        turn = first.rotation @ self._first.rotation.T
        arm = self._second.translation - self._first.translation
        second = Pose(turn @ self._second.rotation, first.translation + turn @ arm)
        points, pixels = in_view(self._points, first, self._cameras[0])
        if not len(points):
            return np.inf, second
        anchors = anchors_at(points, pixels, self._features[0])
        origin = local_origin(anchors, second)
        problem = level_problems(self._features[1], self._cameras[1], anchors, origin)[0]
        R, t = camera_from_local(second.rotation[None], second.translation[None], origin)
        if self._scale is None:  # the same for all, or they could not be compared
            self._scale = max(median_residual(problem, R[0], t[0]), _LEAST_SCALE)
        settings = LMSettings(
            self._scale, redescending=True, damping=_DAMPING, min_overlap=_LEAST_OVERLAP
        )
        found = self._backend.refine(problem, R, t, _STEPS, settings)
        rotations, centres = world_from_camera(found.rotations, found.translations, origin)
        return float(found.scores[0]), Pose(rotations[0], centres[0])


def _finest(features: FeaturePyramid) -> FeaturePyramid:
    level = features.levels[-1]
    smooth = cv2.GaussianBlur(level.features, (0, 0), _BLUR_PX).astype(np.float32, copy=False)
    blurred = FeatureLevel(smooth, level.confidence, level.stride)
    return FeaturePyramid((blurred,), features.width, features.height)
