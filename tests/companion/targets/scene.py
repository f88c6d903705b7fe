"""A moving camera over ground with a flat roof, for tests of targets: no thread, no clock."""

import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.pick import cast_bundle
from localizer.map.cache.tile import TileMesh
from localizer.types import PoseEstimate, RegistrationStatus, TrackingState

CAMERA = Camera(640, 480, 502.0, 502.0, 320.0, 240.0, (-0.09, 0.02, 0.0006, -0.0004, 0.0))
MS = 1_000_000
DOWN = np.diag([1.0, -1.0, -1.0])


def square(side, height, middle=(0.0, 0.0)):
    """A horizontal square with a plain texture."""
    corners = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) * side / 2 + np.array(middle)
    return TileMesh(
        np.column_stack([corners, np.full(4, height)]).astype(np.float32),
        np.zeros((4, 2), np.float32),
        np.array([[0, 1, 2], [1, 3, 2]], np.int32),
        (np.zeros((4, 4, 3), np.uint8),),
        Pose.identity(),
    )


MESHES = [square(2000.0, 0.0), square(20.0, 8.0)]


def cast(origin, directions):
    """Rays against ground and roof."""
    return cast_bundle(MESHES, origin, directions)


def pose_at(time_s, speed=10.0, turn=0.0):
    """Flies east at 100 m, looks down and sways; turn: of the heading, rad/s."""
    sway = so3_exp([0.15 * np.sin(0.9 * time_s), 0.1 * np.sin(0.7 * time_s), turn * time_s])
    return Pose(sway @ DOWN, np.array([speed * time_s - 40.0, 5.0 * np.sin(0.3 * time_s), 100.0]))


def estimate(pose, time_ns, state=TrackingState.TRACKING, sigma=0.01, accepted=True, camera=CAMERA):
    """What a localizer would say of it."""
    P = np.diag(np.repeat([sigma, sigma * 1e-2], 3) ** 2)
    return PoseEstimate(pose, P, 1.0, state, RegistrationStatus.OK, accepted, time_ns, 0, camera)
