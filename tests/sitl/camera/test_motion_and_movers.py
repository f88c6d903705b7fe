"""Interpolated truth, and objects whose place is a function of time."""

from __future__ import annotations

import numpy as np

from companion.geometry import GimbalAngles, Mount
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, matrix_from_euler, quaternion_from_matrix, so3_exp
from localizer.map.cache.tile import TileMesh
from sitl.camera.movers import Mover
from sitl.camera.true_motion import PoseTrack, TruthSample, camera_pose

MESH = TileMesh(
    np.zeros((3, 3), np.float32),
    np.zeros((3, 2), np.float32),
    np.array([[0, 1, 2]], np.int32),
    (np.zeros((1, 1, 3), np.uint8),),
    Pose.identity(),
)
SQUARE = np.array([[0.0, 0, 1], [40, 0, 1], [40, 40, 1], [0, 40, 1]])


def test_a_track_interpolates_position_and_rotation_evenly() -> None:
    a = Pose(np.eye(3), np.zeros(3))
    b = Pose(so3_exp([0, 0, 1.0]), np.array([10.0, 0, -2]))
    track = PoseTrack([(1000, a), (2000, b)])
    middle = track.at(1250)
    assert middle is not None
    np.testing.assert_allclose(middle.translation, [2.5, 0, -0.5])
    np.testing.assert_allclose(middle.rotation, so3_exp([0, 0, 0.25]), atol=1e-12)
    assert track.at(999) is None
    assert track.at(2001) is None
    assert track.at(2000) is not None


def test_a_vehicles_sample_gives_its_cameras_pose() -> None:
    frame = LocalFrame(Geodetic(47.0, 8.0, 430.0))
    body = quaternion_from_matrix(matrix_from_euler(0.1, -0.05, np.pi / 2))
    sample = TruthSample(5, np.array([10.0, 20, 120]), body, GimbalAngles(0, -np.pi / 2, 0))
    pose = camera_pose(sample, frame, Mount.from_degrees())
    np.testing.assert_allclose(pose.translation, [10, 20, 120])
    # Heading east and looking down: the image's up is east, its right is south.
    np.testing.assert_allclose(pose.rotation, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-4)


def test_a_mover_goes_round_at_its_speed() -> None:
    mover = Mover("a", SQUARE, speed_mps=8.0, phase_m=5.0, mesh=MESH, epoch_ns=10**9)
    np.testing.assert_allclose(mover.position_at(10**9), [5, 0, 1])
    np.testing.assert_allclose(mover.position_at(2 * 10**9), [13, 0, 1])
    np.testing.assert_allclose(mover.velocity_at(2 * 10**9), [8, 0, 0], atol=1e-12)
    np.testing.assert_allclose(mover.position_at(21 * 10**9), mover.position_at(10**9), atol=1e-9)
    pose = mover.pose_at(10**9 + 8 * 10**9)  # 69 m along: on the way north
    np.testing.assert_allclose(pose.rotation[:, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(pose.rotation[:, 2], [0, 0, 1])
    np.testing.assert_allclose(pose.translation, [40, 29, 1])
