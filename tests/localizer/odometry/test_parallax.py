"""The keyframe's pose from how the picture moved over the map's shape."""

import numpy as np
import pytest

from localizer.geometry.pose import Array, Pose, hat, so3_exp, so3_log
from localizer.odometry.parallax import ParallaxAlignment, ParallaxView, align
from localizer.registration.cpu.kernel import NumbaBackend
from tests.localizer.odometry.conftest import CAMERA, Flight
from tests.localizer.registration.conftest import SyntheticPlace

FIRST, SECOND = 0, 6  # 24 m apart
NOISE = 0.02


@pytest.fixture(scope="module")
def mountains() -> Flight:
    return Flight(SyntheticPlace.from_seed(7, relief_m=25.0))


def prior(flight: Flight, tilt_deg: float, shift_m: float) -> tuple[Array, Array]:
    """Covariance (6, 6) and its root of a pose that keeps the ground in the picture's middle."""
    pose = flight.pose(FIRST)
    arm = pose.rotation[:, 2] * 100.0 / -pose.rotation[2, 2]
    root = np.zeros((6, 6))
    root[:3, :3] = shift_m * np.eye(3)
    root[3:, 3:] = np.radians(tilt_deg) * np.eye(3)
    root[:3, 3:] = hat(arm) @ root[3:, 3:]
    return root @ root.T, root


def aligned(flight: Flight, step: Array, covariance: Array) -> ParallaxAlignment | None:
    first, second = flight.pose(FIRST), flight.pose(SECOND)
    turn = so3_exp(step[3:])
    moved = Pose(turn @ first.rotation, first.translation + step[:3])
    arm = turn @ (second.translation - first.translation)
    after = Pose(turn @ second.rotation, moved.translation + arm)
    views = (
        ParallaxView(flight.frame(FIRST).features, moved, CAMERA),
        ParallaxView(flight.frame(SECOND).features, after, CAMERA),
    )
    return align(NumbaBackend(1), *views, flight.surface(FIRST), covariance, NOISE)


def off(pose: Pose, truth: Pose) -> Array:
    turn = np.degrees(so3_log(pose.rotation @ truth.rotation.T))
    return np.concatenate([pose.translation - truth.translation, turn])


def test_a_keyframe_that_is_off_is_brought_to_the_maps_shape(mountains: Flight) -> None:
    covariance, root = prior(mountains, 1.0, 0.5)
    before, after, distances, narrower = [], [], [], []
    for seed in range(4):
        step = root @ np.random.default_rng(seed).normal(0, 1, 6)
        found = aligned(mountains, step, covariance)
        assert found is not None
        error = off(found.first, mountains.pose(FIRST))
        before.append(np.degrees(step[3:5]))
        after.append(error[3:5].copy())
        error[3:] = np.radians(error[3:])
        distances.append(error @ np.linalg.solve(found.covariance, error) / 6)
        narrower.append(np.linalg.det(found.covariance) / np.linalg.det(covariance))
        # The second picture's pose goes along.
        second = off(found.second, mountains.pose(SECOND))
        np.testing.assert_allclose(second[3:5], after[-1], atol=0.5)
    assert np.linalg.norm(after) < 0.85 * np.linalg.norm(before)  # small pictures, no detail
    assert np.mean(distances) < 3.0
    # Over the draws: this prior's axes are equally long, so which of them the cost is sampled along
    # is the linear algebra library's choice, and one draw's figure differs between processors.
    assert np.exp(np.mean(np.log(narrower))) < 0.1
    assert max(narrower) < 0.5


def test_a_keyframe_that_is_right_stays_there(mountains: Flight) -> None:
    covariance, _ = prior(mountains, 0.2, 0.1)
    found = aligned(mountains, np.zeros(6), covariance)
    assert found is not None
    error = off(found.first, mountains.pose(FIRST))
    error[3:] = np.radians(error[3:])
    assert error @ np.linalg.solve(covariance, error) < 4.0


def test_nothing_is_told_where_nothing_is_seen(mountains: Flight) -> None:
    covariance, _ = prior(mountains, 0.2, 0.1)
    elsewhere = mountains.surface(FIRST) + np.array([5000.0, 0.0, 0.0])
    view = ParallaxView(mountains.frame(FIRST).features, mountains.pose(FIRST), CAMERA)
    assert align(NumbaBackend(1), view, view, elsewhere, covariance, NOISE) is None
