"""SE(3) by its group properties."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from localizer.errors import CameraError, PoseFileError
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import (
    Pose,
    euler_from_matrix,
    hat,
    matrix_from_euler,
    matrix_from_quaternion,
    quaternion_from_matrix,
    so3_exp,
    so3_log,
)
from localizer.geometry.shutter import Sweep
from localizer.geometry.trajectory import pose_row, read_poses, world_from_camera, write_poses


def vectors(limit):
    return st.lists(st.floats(-limit, limit), min_size=3, max_size=3).map(np.array)


def rotations():
    """Rotation vectors of every size, tiny ones and half turns included."""
    axis = vectors(1.0).filter(lambda v: np.linalg.norm(v) > 1e-3)
    angle = st.one_of(
        st.floats(0, np.pi - 1e-6), st.floats(-12, -3).map(lambda e: 10.0**e), st.just(0.0)
    )
    return st.tuples(axis, angle).map(lambda p: p[0] / np.linalg.norm(p[0]) * p[1])


def poses():
    return st.tuples(rotations(), vectors(1e4)).map(lambda p: Pose(so3_exp(p[0]), p[1]))


def close(a, b, tolerance=1e-9):
    np.testing.assert_allclose(a.rotation, b.rotation, atol=tolerance)
    np.testing.assert_allclose(a.translation, b.translation, atol=1e4 * tolerance)


@given(rotations())
def test_so3_exp_is_a_rotation_and_the_matrix_exponential(phi):
    R = so3_exp(phi)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R, expm(hat(phi)), atol=1e-9)


@given(rotations())
def test_so3_log_inverts_exp(phi):
    np.testing.assert_allclose(so3_log(so3_exp(phi)), phi, atol=1e-8)


@pytest.mark.parametrize("axis", np.eye(3))
def test_so3_log_of_a_half_turn(axis):
    phi = so3_log(so3_exp(np.pi * axis))
    np.testing.assert_allclose(np.abs(phi), np.pi * axis, atol=1e-7)


@given(vectors(50.0), rotations())
def test_se3_exp_is_the_matrix_exponential_and_log_its_inverse(rho, phi):
    xi = np.concatenate([rho, phi])
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = hat(phi), rho
    pose = Pose.exp(xi)
    np.testing.assert_allclose(pose.matrix, expm(twist), atol=1e-7)
    # Near a half turn the translation part of the logarithm is ill-conditioned.
    if np.linalg.norm(phi) < 3.0:
        np.testing.assert_allclose(pose.log(), xi, atol=1e-6)


@given(poses())
def test_apply_keeps_the_shape_and_the_distances(pose):
    points = np.arange(24.0).reshape(2, 4, 3)
    moved = pose.apply(points)
    assert moved.shape == points.shape
    np.testing.assert_allclose(
        np.linalg.norm(moved[0] - moved[1], axis=1),
        np.linalg.norm(points[0] - points[1], axis=1),
        atol=1e-6,
    )


@given(rotations())
def test_quaternions(phi):
    R = so3_exp(phi)
    q = quaternion_from_matrix(R)
    assert q[0] >= 0
    assert np.linalg.norm(q) == pytest.approx(1.0)
    np.testing.assert_allclose(matrix_from_quaternion(q), R, atol=1e-9)
    np.testing.assert_allclose(matrix_from_quaternion(-3.0 * q), R, atol=1e-9)


@given(st.floats(-np.pi, np.pi), st.floats(-1.5, 1.5), st.floats(-np.pi, np.pi))
def test_euler_angles(roll, pitch, yaw):
    R = matrix_from_euler(roll, pitch, yaw)
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(R, expected, atol=1e-12)
    np.testing.assert_allclose(matrix_from_euler(*euler_from_matrix(R)), R, atol=1e-9)
    np.testing.assert_allclose(euler_from_matrix(R)[1], pitch, atol=1e-7)


@settings(max_examples=30)
@given(poses(), st.floats(0, 500), st.floats(0, 179))
def test_distance_is_the_papers_error_measure(pose, metres, degrees):
    axis = np.array([0.6, 0.0, 0.8])
    other = Pose(pose.rotation @ so3_exp(np.radians(degrees) * axis), pose.translation.copy())
    other = Pose(other.rotation, other.translation + metres * np.array([0.0, 0.6, -0.8]))
    distance, angle = pose.distance_to(other)
    assert distance == pytest.approx(metres, abs=1e-6)
    assert angle == pytest.approx(degrees, abs=1e-5)
    assert other.distance_to(pose) == pytest.approx((distance, angle), abs=1e-6)


# --- posefile -----------------------------------------------------------------------------------


FRAME = LocalFrame(Geodetic(47.3, 8.5, 450.0))


def test_zero_angles_look_at_the_nadir_with_north_up():
    row = pose_row("x.jpg", Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)), FRAME)
    assert (row.roll_deg, row.pitch_deg, row.yaw_deg) == pytest.approx((0, 0, 0), abs=1e-9)
    R = world_from_camera(row, FRAME).rotation
    np.testing.assert_allclose(R @ [0, 0, 1], [0, 0, -1], atol=1e-9)  # optical axis: down
    np.testing.assert_allclose(R @ [0, -1, 0], [0, 1, 0], atol=1e-9)  # image up: north


def test_yaw_counts_counter_clockwise(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("a.jpg 8.5 47.3 450 0 0 90\n")
    R = world_from_camera(read_poses(path)[0], FRAME).rotation
    np.testing.assert_allclose(R @ [0, -1, 0], [-1, 0, 0], atol=1e-9)  # image up: west


@pytest.mark.parametrize("seed", range(5))
def test_round_trip_through_a_file(tmp_path, seed):
    rng = np.random.default_rng(seed)
    pose = Pose(so3_exp(rng.normal(0, 0.6, 3)) @ np.diag([1.0, -1, -1]), rng.normal(0, 3000, 3))
    path = tmp_path / "poses.txt"
    write_poses(path, [pose_row("a.jpg", pose, FRAME)])
    back = world_from_camera(read_poses(path)[0], FRAME)
    translation, rotation = pose.distance_to(back)
    assert translation < 5e-4
    assert rotation < 1e-5


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "holds no pose"),
        ("a.jpg 8 47 450 0 0\n", "6 fields"),
        ("a.jpg 8 147 450 0 0 0\n", "out of range"),
        ("a.jpg 8 47 450 0 nan 0\n", "finite"),
        ("a.jpg 8 47 high 0 0 0\n", "could not convert"),
        ("a.jpg 8 47 0 0 0 0\na.jpg 8 48 0 0 0 0\n", r"2 lines are of a\.jpg"),
    ],
)
def test_bad_lines_name_file_and_line(tmp_path, text, what):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(PoseFileError, match=what):
        read_poses(path)


@pytest.mark.real
def test_caliterra_pose_lines_agree_with_its_matrices(real_data):
    folder = real_data("caliterra")
    origin = json.loads((folder / "georef.json").read_text())["origin"]
    frame = LocalFrame(Geodetic(origin["lat"], origin["lon"], origin["height"]))
    matrices = json.loads((folder / "queries" / "poses.json").read_text())
    for row in read_poses(folder / "queries" / "poses.txt"):
        truth = Pose.from_matrix(matrices[row.name]["T_enu_from_cam"])
        translation, rotation = truth.distance_to(world_from_camera(row, frame))
        assert translation < 2e-3
        assert rotation < 2e-3


# --- A rolling shutter: where a moving camera sees a point, held to the row's own pose ----------


CAMERA = Camera(640, 480, 500.0, 505.0, 322.0, 238.0, (-0.09, 0.02, 6e-4, -4e-4, 0.0), 20.0)
DOWN = Pose(np.diag([1.0, -1.0, -1.0]), np.array([40.0, -20.0, 120.0]))
RATE, VELOCITY = np.radians([60.0, -20.0, 45.0]), np.array([9.0, -4.0, 1.0])


def _ground(count: int = 300) -> np.ndarray:
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-55, 55, (count, 2)), rng.uniform(0, 25, count)])
    return points + np.array([40.0, -20.0, 0.0])


def _pixels_row_by_row(points: np.ndarray) -> np.ndarray:
    """Each point projected from the pose at the time at which its own row is read out."""
    seen = []
    for point in points:
        row = CAMERA.height / 2
        for _ in range(30):
            time_s = (row / CAMERA.height - 0.5) * 1e-3 * CAMERA.readout_ms
            turned = so3_exp(RATE * time_s) @ DOWN.rotation
            pose = Pose(turned, DOWN.translation + VELOCITY * time_s)
            pixel, _ = CAMERA.project(pose.inverse.apply(point))
            row = float(np.clip(pixel[1], 0, CAMERA.height))
        seen.append(pixel)
    return np.array(seen)


def test_the_moved_points_are_seen_where_the_rolling_camera_sees_the_true_ones():
    points, sweep = _ground(), Sweep.of(RATE, VELOCITY, CAMERA.readout_ms)
    rolled = _pixels_row_by_row(points)
    still, inside = CAMERA.project(DOWN.inverse.apply(points))
    moved, _ = CAMERA.project(DOWN.inverse.apply(sweep.apparent_points(points, DOWN, CAMERA)))
    assert np.linalg.norm(still - rolled, axis=1)[inside].max() > 4.0  # what is mended
    assert np.linalg.norm(moved - rolled, axis=1)[inside].max() < 0.05


def test_a_camera_that_stands_still_sweeps_nothing():
    points, still = _ground(), Sweep.of(np.zeros(3), np.zeros(3), 20.0)
    assert np.allclose(still.apparent_points(points, DOWN, CAMERA), points, atol=1e-9)
    assert not still.displaces_pixels(CAMERA, 120.0)
    assert not Sweep.of(RATE, VELOCITY, 0.0).displaces_pixels(CAMERA, 120.0)
    assert Sweep.of(np.zeros(3), VELOCITY, 20.0).displaces_pixels(CAMERA, 120.0)


@pytest.mark.parametrize("readout_ms", [-1.0, 1e4, float("nan")])
def test_a_readout_that_no_shutter_has_is_named(readout_ms):
    with pytest.raises(CameraError, match="readout"):
        Camera(640, 480, 500, 500, 320, 240, readout_ms=readout_ms)


def test_the_readout_is_kept_in_camera_files_and_sizes():
    assert Camera.from_dict(CAMERA.to_dict()) == CAMERA
    assert CAMERA.resized(320, 240).without_distortion().readout_ms == 20.0
