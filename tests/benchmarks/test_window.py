"""The window's votes: weak ones add up, wrong ones are left out, motion carries them."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.window.motions import MOTIONS, MotionStep
from benchmarks.window.report import Error, rows
from benchmarks.window.votes import Vote, Window, elected
from localizer.geometry.pose import Pose, so3_exp

INTERVAL_S = 0.5
SIGMA = np.diag([1.0] * 3 + [np.radians(1.0) ** 2] * 3)


def _flight(count):
    turn = so3_exp((0.0, 0.0, 0.03))
    poses = [Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 100.0]))]
    for _ in range(count - 1):
        poses.append(
            Pose(turn @ poses[-1].rotation, poses[-1].translation + np.array([6.0, 0.5, 0.0]))
        )
    return poses


def _beside(pose, rng, metres=1.0, degrees=1.0):
    turn = so3_exp(np.radians(rng.normal(0.0, degrees, 3)))
    return Pose(turn @ pose.rotation, pose.translation + rng.normal(0.0, metres, 3))


def test_one_vote_is_its_pose():
    vote = Vote(_flight(1)[0], SIGMA, 0.5)
    assert elected([vote]).distance_to(vote.pose) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_weak_votes_add_up():
    rng, truth = np.random.default_rng(0), _flight(1)[0]
    votes = [Vote(_beside(truth, rng), SIGMA, 0.5) for _ in range(30)]
    metres, degrees = elected(votes).distance_to(truth)
    assert metres < 0.6
    assert degrees < 0.6


@pytest.mark.parametrize(("robust", "right"), [(True, True), (False, False)])
def test_wrong_places_are_left_out_where_more_agree(robust, right):
    rng, truth = np.random.default_rng(1), _flight(1)[0]
    wrong = [Pose(truth.rotation, truth.translation + way) for way in 8.0 * np.eye(3)]
    votes = [Vote(_beside(truth, rng, 0.3, 0.2), SIGMA / 9, 0.5) for _ in range(5)]
    votes += [Vote(pose, SIGMA / 9, 0.5) for pose in wrong]
    assert (elected(votes, robust=robust).distance_to(truth)[0] < 1.0) == right


@pytest.mark.parametrize("motion", MOTIONS)
def test_votes_are_carried_along_the_flight(motion):
    truths = _flight(8)
    steps = MOTIONS[motion](truths, INTERVAL_S, np.random.default_rng(2))
    window = Window(5)
    told = [
        window.add(Vote(truth, SIGMA, 0.5), step)
        for truth, step in zip(truths, [None, *steps], strict=True)
    ]
    assert told[-1].distance_to(truths[-1])[0] < 1.0
    _, covariance = steps[0].carry(truths[0], SIGMA)
    assert (np.linalg.eigvalsh(covariance - SIGMA)[-1]) > 0.0


def test_a_turn_that_is_not_known_is_a_place_that_is_not_known():
    step = MotionStep(lambda pose: pose, np.array([100.0, 0.0, 0.0]), np.zeros((6, 6)))
    _, covariance = step.carry(_flight(1)[0], SIGMA)
    assert covariance[1, 1] == pytest.approx(1.0 + 100.0**2 * np.radians(1.0) ** 2)


def test_the_table_counts_from_the_fifth_frame():
    far, near = [Error(np.full(3, 5.0), 9.0)] * 4, [Error(np.full(3, 0.2), 0.5)] * 4
    places = [{("", "single", 1): far + near, ("odometry", "vote", 5): far + far}] * 2
    single, window = rows("dusk", "alike", places)
    assert single[6:8] == ("100", "")
    assert window[6:8] == ("0", "-100 (-100, -100)")


@pytest.mark.parametrize(("sign", "shared"), [(1.0, "100 %"), (-1.0, "0 %")])
def test_what_the_frames_share_stands_apart(sign, shared):
    frames = [Error(side * np.array([0.0, 3.0, 0.0]), 0.5) for side in (1.0, sign)] * 4
    assert rows("dusk", "alike", [{("", "single", 1): frames}])[0][-1] == shared
