"""What autopilot and gimbal are off by is learned, and what is wrong of them is not believed."""

from __future__ import annotations

import numpy as np
import pytest

from localizer.geometry.pose import Array, Pose, so3_exp, so3_log
from localizer.tracking.attitude_bias import (
    AttitudeBias,
    AttitudeBiasEstimator,
    AttitudeObservation,
    AttitudePrior,
    constraint,
    horizontal_axes,
    initial_bias,
    is_new_ground,
    with_observation,
)

CONFIG = AttitudePrior(tilt_sigma_deg=0.3, alignment_sigma_deg=1.0)
STEP_NS = 5_000_000_000


def camera(yaw_deg: float, pitch_deg: float = -60.0) -> Array:
    """world_from_camera of a camera that looks so far below the horizon, to that azimuth."""
    level = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # looks north
    turn = so3_exp([0, 0, -np.radians(yaw_deg)])
    return turn @ so3_exp([np.radians(pitch_deg), 0, 0]) @ level


def tilted(rotation: Array, pitch_deg: float, roll_deg: float) -> Array:
    """The true rotation of a reported one, by errors about the two axes."""
    axes = horizontal_axes(rotation)
    assert axes is not None
    return so3_exp(axes @ np.radians([pitch_deg, roll_deg])) @ rotation


def flown(
    bias: AttitudeBias, off_deg: tuple[float, float], count: int, *, wander_deg: float = 0.3,
    vision_deg: float = 0.15, distance_m: float = 110.0, seed: int = 0,
) -> AttitudeBias:  # fmt: skip
    """After `count` sights over new ground, the camera turning by 37 degrees between them."""
    rng = np.random.default_rng(seed)
    covariance = np.eye(6) * np.radians(vision_deg) ** 2
    for k in range(count):
        reported = camera(37.0 * k)
        wander = rng.normal(0, wander_deg, 2)
        true = tilted(reported, off_deg[0] + wander[0], off_deg[1] + wander[1])
        seen = so3_exp(rng.normal(0, np.radians(vision_deg), 3)) @ true
        pose = Pose(seen, np.array([60.0 * k, 0.0, 100.0]))
        sight = AttitudeObservation(pose, covariance, distance_m, k * STEP_NS)
        bias = with_observation(bias, CONFIG, reported, sight)
    return bias


def test_the_axes_are_the_cameras_right_and_what_lies_ahead():
    axes = horizontal_axes(camera(90.0, -45.0))  # looks east: its right is south
    np.testing.assert_allclose(axes, [[0, 1], [-1, 0], [0, 0]], atol=1e-12)
    down = horizontal_axes(camera(0.0, -90.0))
    np.testing.assert_allclose(down, [[1, 0], [0, 1], [0, 0]], atol=1e-12)


def test_a_constant_is_learned_whatever_way_the_camera_turns():
    bias = flown(initial_bias(CONFIG), (1.2, -0.8), 30)
    assert np.abs(np.array(bias.off_deg) - (1.2, -0.8)).max() < 0.15
    assert np.degrees(bias.sigma_rad) < 0.4


@pytest.mark.parametrize("seed", range(20))
def test_what_it_tells_of_itself_is_honest(seed):
    rng = np.random.default_rng([seed, 1])
    true = rng.normal(0, 0.8, 2)
    bias = flown(initial_bias(CONFIG), (float(true[0]), float(true[1])), 15, seed=seed)
    off = np.radians(np.array(bias.off_deg) - true)
    assert off @ np.linalg.solve(bias.covariance, off) < 18.4  # 99.99 % of two numbers


def test_a_gimbal_that_wanders_more_is_believed_less():
    steady = flown(initial_bias(CONFIG), (0.5, 0.5), 60)
    wild = flown(initial_bias(CONFIG), (0.5, 0.5), 60, wander_deg=1.2)
    assert np.degrees(steady.sigma_rad) < 0.45
    assert np.degrees(wild.sigma_rad) > 0.9


def test_one_that_is_said_to_be_bad_stays_so():
    """8 degrees were 3 from the first sight on."""
    config = AttitudePrior(tilt_sigma_deg=8.0)
    sight = AttitudeObservation(Pose(camera(0.0), np.zeros(3)), np.eye(6) * 1e-6, 110.0, STEP_NS)
    bias = with_observation(initial_bias(config), config, camera(0.0), sight)
    assert np.degrees(bias.sigma_rad) >= 8.0


def test_a_frame_is_constrained_in_tilt_alone_at_the_corrected_rotation():
    bias = flown(initial_bias(CONFIG), (1.2, -0.8), 30)
    reported = camera(200.0)
    true = tilted(reported, 1.2, -0.8)
    found = constraint(bias, reported)
    off = np.degrees(so3_log(found.world_from_camera.rotation @ true.T))
    assert np.abs(off).max() < 0.15
    assert not found.information[:3].any()
    assert not found.information[5].any()  # no heading
    sigmas = np.degrees(1 / np.sqrt(np.linalg.eigvalsh(found.information[3:5, 3:5])))
    assert 0.3 <= sigmas.min() <= sigmas.max() < 0.45


def test_a_gimbal_that_was_knocked_is_never_learned():
    after = flown(flown(initial_bias(CONFIG), (0.3, 0.1), 20), (10.3, 0.1), 20)
    assert max(np.abs(after.off_deg)) < 1.0


def test_one_that_was_knocked_a_little_is_learned_anew():
    after = flown(flown(initial_bias(CONFIG), (0.0, 0.0), 40), (2.5, 0.0), 40)
    assert abs(after.off_deg[0] - 2.5) < 0.4


def test_one_wrong_place_teaches_little():
    bias = flown(initial_bias(CONFIG), (0.5, 0.0), 20)
    reported = camera(10.0)
    wrong = AttitudeObservation(
        Pose(tilted(reported, 4.0, 0.0), np.array([5e3, 0, 0])),
        np.eye(6) * np.radians(0.3) ** 2, 110.0, 10**12,
    )  # fmt: skip
    assert abs(with_observation(bias, CONFIG, reported, wrong).off_deg[0] - 0.5) < 0.2


def test_from_low_down_a_sight_counts_less():
    high = flown(initial_bias(CONFIG), (1.0, 0.0), 3)
    low = flown(initial_bias(CONFIG), (1.0, 0.0), 3, distance_m=30.0)
    assert low.covariance[0, 0] > 1.5 * high.covariance[0, 0]


def test_the_same_ground_is_measured_once():
    bias = flown(initial_bias(CONFIG), (1.0, 0.0), 1)
    assert not is_new_ground(bias, np.array([40.0, 0.0, 100.0]), 100.0)
    assert is_new_ground(bias, np.array([60.0, 0.0, 100.0]), 100.0)
    assert not is_new_ground(bias, np.array([15.0, 0.0, 20.0]), 20.0)


def test_ground_that_tells_nothing_is_looked_at_once_too():
    """From 15 m every frame was registered a second time, for nothing."""
    place = np.array([60.0, 0.0, 15.0])
    unsure = AttitudeObservation(
        Pose(camera(0.0), place), np.eye(6) * np.radians(0.5) ** 2, 15.0, STEP_NS
    )
    bias = with_observation(initial_bias(CONFIG), CONFIG, camera(0.0), unsure)
    assert bias.off_deg == (0.0, 0.0)
    assert not is_new_ground(bias, place, 15.0)
    failed = AttitudeBiasEstimator(CONFIG, lambda _: camera(0.0))
    assert failed.is_due(place, 15.0)
    failed.skip_ground(place, STEP_NS)
    assert not failed.is_due(place, 15.0)
    unreported = AttitudeBiasEstimator(CONFIG, lambda _: None)
    unreported.learn(unsure)
    assert not unreported.is_due(place, 15.0)


def test_on_its_side_or_unreported_there_is_none():
    side = so3_exp([0, np.radians(90), 0]) @ camera(0.0, 0.0)
    assert constraint(initial_bias(CONFIG), side) is None
    assert AttitudeBiasEstimator(CONFIG, lambda _: None).constraint(0) is None
    off = AttitudeBiasEstimator(None, lambda _: camera(0.0))
    assert off.constraint(0) is None
    assert not off.is_due(np.zeros(3), 100.0)
