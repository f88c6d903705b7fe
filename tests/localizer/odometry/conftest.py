"""A flight over a place whose features are known in closed form."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.odometry.estimate import OdometryFrame
from tests.localizer.registration.conftest import SyntheticPlace, camera_pose

CAMERA = Camera(160, 120, 150.0, 144.0, 76.0, 63.5)
STEP_NS = 400_000_000
SPEED_M_S = 10.0
BEGUN = np.diag([0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3]) ** 2
VELOCITY = np.array([0.0, SPEED_M_S, 0.0])


@dataclass(frozen=True)
class Flight:
    """Straight north at 10 m/s, 100 m above the mean ground, with a slow weave."""

    place: SyntheticPlace
    _frames: dict[int, OdometryFrame] = field(default_factory=dict)

    def pose(self, k: int) -> Pose:
        t = k * STEP_NS * 1e-9
        position = np.array([3 * np.sin(0.2 * t), SPEED_M_S * t, 100 + 2 * np.sin(0.3 * t)])
        return camera_pose(position, 75 + 2 * np.sin(0.5 * t), 3 * np.sin(0.4 * t))

    def frame(self, k: int) -> OdometryFrame:
        if k not in self._frames:
            features = self.place.pyramid(self.pose(k), CAMERA, 0.05, seed=k)
            self._frames[k] = OdometryFrame(features, k * STEP_NS)
        return self._frames[k]

    def surface(self, k: int) -> Array:
        """Points of the map's geometry as seen from about there."""
        pose = self.pose(k)
        near = Pose(pose.rotation, pose.translation + np.array([0.7, -0.5, 0.4]))
        v, u = np.mgrid[3 : CAMERA.height : 5, 3 : CAMERA.width : 5]
        pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
        depth = self.place.hit(near, CAMERA, pixels)
        return near.apply(CAMERA.rays(pixels) * depth[:, None])


@pytest.fixture(scope="session")
def hills() -> Flight:
    return Flight(SyntheticPlace.from_seed(7))


@pytest.fixture(scope="session")
def plain() -> Flight:
    return Flight(SyntheticPlace.from_seed(7, relief_m=0.6))
