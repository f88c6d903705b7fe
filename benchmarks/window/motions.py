"""What ties the frames of a window: the motion between two of them, as other sources measure it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from localizer.geometry.pose import Array, Pose, hat, so3_exp

_SCALE, _STEP_M, _STEP_DEG = 0.005, 0.02, 0.02  # the odometry's, over the map's geometry
_VELOCITY_MPS, _WALK_M = 0.2, 0.03  # the autopilot's velocity without GNSS: constant, and a walk
_JITTER_DEG = 0.2  # of its attitude and the gimbal's angles, from frame to frame


@dataclass(frozen=True)
class MotionStep:
    """The motion from one frame to the next.

    move: a pose of the earlier camera to one of the later; lever: the way (3,) in the earlier
    camera's axes that turns with an error of its rotation, zero where the way is known in world
    axes; noise: covariance (6, 6) that the step adds.
    """

    move: Callable[[Pose], Pose]
    lever: Array
    noise: Array

    def carry(self, pose: Pose, covariance: Array) -> tuple[Pose, Array]:
        """A pose and its covariance (as `PosePrior`'s) of the later camera."""
        spread = np.eye(6)
        spread[:3, 3:] = -hat(pose.rotation @ self.lever)
        return self.move(pose), spread @ covariance @ spread.T + self.noise


def by_odometry(
    truths: Sequence[Pose], _interval_s: float, rng: np.random.Generator
) -> list[MotionStep]:
    """Frame to frame in camera axes: an error of scale that stays, and a walk."""
    scale = 1.0 + rng.normal(0.0, _SCALE, 3)
    steps = []
    for before, after in pairwise(truths):
        true = before.inverse @ after
        turn = so3_exp(np.radians(rng.normal(0.0, _STEP_DEG, 3)))
        way = true.translation * scale + rng.normal(0.0, _STEP_M, 3)
        measured = Pose(turn @ true.rotation, way)
        sigma_m = _STEP_M + _SCALE * float(np.linalg.norm(way))
        steps.append(
            MotionStep(lambda pose, m=measured: pose @ m, way, _noise(sigma_m, _STEP_DEG))  # type: ignore[misc]
        )
    return steps


def by_autopilot(
    truths: Sequence[Pose], interval_s: float, rng: np.random.Generator
) -> list[MotionStep]:
    """Velocity and attitude in world axes: a velocity that stays wrong, and jitter."""
    wrong = rng.normal(0.0, _VELOCITY_MPS, 3)
    seen = [so3_exp(np.radians(rng.normal(0.0, _JITTER_DEG, 3))) @ t.rotation for t in truths]
    steps = []
    for (before, after), (turned, turns) in zip(pairwise(truths), pairwise(seen), strict=True):
        way = after.translation - before.translation
        way = way + wrong * interval_s + rng.normal(0.0, _WALK_M, 3)
        turn = turns @ turned.T
        noise = _noise(_WALK_M + _VELOCITY_MPS * interval_s, 1.4 * _JITTER_DEG)
        steps.append(MotionStep(partial(_shifted, way=way, turn=turn), np.zeros(3), noise))
    return steps


def _shifted(pose: Pose, way: Array, turn: Array) -> Pose:
    return Pose(turn @ pose.rotation, pose.translation + way)


def _noise(sigma_m: float, sigma_deg: float) -> Array:
    return np.diag([sigma_m**2] * 3 + [np.radians(sigma_deg) ** 2] * 3)


MOTIONS = {"odometry": by_odometry, "autopilot": by_autopilot}
