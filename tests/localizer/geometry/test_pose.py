"""SE(3) by its group properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

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
