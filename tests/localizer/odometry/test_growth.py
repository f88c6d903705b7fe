"""The algebra of errors that grow."""

import numpy as np
import pytest

from localizer.geometry.pose import Pose, so3_exp
from localizer.odometry.config import GrowthModel
from localizer.odometry.growth import add_scale_error, fuse, transferred, without_constant_error
from localizer.registration.priors import attitude_constraint, combine, height_constraint

MODEL = GrowthModel(scale=0.01, horizontal=0.1, vertical=0.2, tilt=1e-3, heading=2e-3)
SIGMA = np.diag([0.3, 0.2, 0.5, 0.01, 0.02, 0.03]) ** 2


def test_a_carried_pose_errs_as_its_keyframe_does():
    """By Monte Carlo: the same small turn and shift of both."""
    rng = np.random.default_rng(0)
    lever = np.array([30.0, -20.0, 5.0])
    errors = rng.multivariate_normal(np.zeros(6), SIGMA, 20_000)
    moved = [e[:3] + so3_exp(e[3:]) @ lever - lever for e in errors]
    expected = np.cov(np.array(moved).T)
    np.testing.assert_allclose(
        transferred(SIGMA, lever)[:3, :3], expected, atol=0.06 * expected.diagonal().max()
    )


def test_a_way_back_does_not_take_back_what_another_ground_added():
    """Out over a valley and back over a hill, with errors that are opposite, alike or neither."""
    out = np.array([300.0, 0.0, 0.0])
    half = add_scale_error(np.zeros((3, 3)), 0.1, 0.5 * out)
    assert add_scale_error(half, 0.1, 0.5 * out)[0, 0] ** 0.5 == pytest.approx(30.0)
    there = add_scale_error(add_scale_error(np.zeros((3, 3)), 0.1, out), 0.2, -out)
    assert there[0, 0] ** 0.5 == pytest.approx(30.0 + 60.0)
    corner = add_scale_error(
        add_scale_error(np.zeros((3, 3)), 0.1, out), 0.1, np.array([0.0, 300.0, 0.0])
    )
    for share in (-1.0, 0.0, 1.0):  # correlation of the two
        whole = 900.0 * np.array([[1.0, share], [share, 1.0]])
        assert np.linalg.eigvalsh(corner[:2, :2] - whole)[0] > -1e-9


def test_a_sensor_is_weighed_against_what_is_known():
    pose = Pose(np.eye(3), np.array([1.0, 2.0, 10.0]))
    after, covariance = fuse(pose, SIGMA, height_constraint(11.0, 0.5))
    assert after.translation == pytest.approx([1.0, 2.0, 10.0])  # it knows no more than we do
    after, covariance = fuse(pose, 4 * SIGMA, height_constraint(11.0, 0.5))
    assert after.translation == pytest.approx([1.0, 2.0, 10.75])
    assert covariance[2, 2] == pytest.approx(0.25)  # the sensor's own: its error stays
    assert covariance[0, 0] == pytest.approx(4 * SIGMA[0, 0])


def test_a_sensor_that_is_asked_often_does_not_average_out():
    pose, covariance = Pose(np.eye(3), np.zeros(3)), SIGMA
    for _ in range(100):
        pose, covariance = fuse(pose, covariance + np.eye(6) * 0.01, height_constraint(1.0, 0.4))
    assert covariance[2, 2] == pytest.approx(0.16)
    assert pose.translation[2] > 0.5  # it follows the sensor nevertheless
    assert np.linalg.eigvalsh(covariance)[0] > 0


def test_what_hangs_on_the_height_moves_with_it():
    """Where east errs as the height does, a barometer mends both."""
    tied = SIGMA.copy()
    tied[0, 0] = tied[2, 2] = 1.0
    tied[0, 2] = tied[2, 0] = 0.9
    after, covariance = fuse(Pose.identity(), tied, height_constraint(1.0, 0.1))
    assert after.translation == pytest.approx([0.9 * 0.99, 0.0, 0.99])
    assert covariance[0, 0] == pytest.approx(1 - 0.81 * 0.99)


def test_a_constant_error_of_compass_and_mounting_is_made_up_for():
    def sensed(pose):
        compass, mounting = so3_exp([0, 0, 0.2]), so3_exp([0.01, -0.02, 0.0])
        return combine(
            attitude_constraint(compass @ pose.rotation @ mounting, 0.01, 0.1),
            height_constraint(pose.translation[2] - 7.0, 0.5),
        )

    down = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 90.0]))
    later = Pose(so3_exp([0.05, 0.03, 2.0]) @ down.rotation, np.array([300.0, 50.0, 95.0]))
    mended = without_constant_error(sensed(later), sensed(down), down).world_from_camera
    assert mended.translation[2] == pytest.approx(95.0)
    assert mended.distance_to(later)[1] < 0.15  # degrees: tilt and compass hardly mix


def test_attitude_turns_the_pose_and_spares_the_heading():
    """A tilt of 2 degrees is mended; a compass that is 30 degrees off and says so is not heard."""
    tilted = Pose(so3_exp([np.radians(2), 0, 0]), np.zeros(3))
    unsure = np.diag([0.1, 0.1, 0.1, 0.05, 0.05, 0.01]) ** 2
    compass = so3_exp([0, 0, np.radians(30)])
    constraint = combine(attitude_constraint(compass, np.radians(0.2), 10.0))
    after, _ = fuse(tilted, unsure, constraint)
    tilt = np.degrees(np.arccos(after.rotation[2, 2]))
    assert tilt < 0.3
    assert abs(np.degrees(np.arctan2(after.rotation[1, 0], after.rotation[0, 0]))) < 0.5
