"""What a localizer would say of a frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.types import PoseEstimate, RegistrationStatus, TrackingState

CAMERA = Camera.from_fov(640, 480, 60.0)
DOWN = np.diag([1.0, -1.0, -1.0])  # a camera straight down whose top is north, in ENU
NADIR = Pose(DOWN, np.array([0.0, 0.0, 100.0]))


def estimated(
    pose: Pose = NADIR, time_ns: int = 5, *, variance: float = 1e-4, **said: Any
) -> PoseEstimate:
    """An accepted estimate while it tracks; said: its other fields."""
    estimate = PoseEstimate(
        pose, np.eye(6) * variance, 1.0, TrackingState.TRACKING, RegistrationStatus.OK, True,
        time_ns, 0, CAMERA,
    )  # fmt: skip
    return replace(estimate, **said)
