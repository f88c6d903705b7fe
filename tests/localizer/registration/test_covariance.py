"""Curvature of the cost, competing modes, and the sandwich made of them (section 8)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localizer.geometry.pose import Pose, so3_exp
from localizer.registration.backend import LMSettings, level_problems, local_origin
from localizer.registration.covariance import (
    NoiseModel,
    anchor_model,
    covariance_sums,
    curvature_ratio,
    curvature_steps,
    image_gap_px,
    mean_motion,
    pose_differences,
    sandwich_covariance,
)
from localizer.registration.cpu.reference import project, projection_jacobian, retractions
from localizer.registration.selection import mode_probabilities, subsample_anchors

PLAIN = NoiseModel(1.0, floor=0.05)
SETTINGS = LMSettings(scale=10.0)  # least squares, so that only noise acts


@pytest.fixture
def problem(scene):
    origin = local_origin(scene.anchors, scene.true)
    return level_problems(scene.query, scene.camera, scene.anchors, origin)[2], origin


@pytest.fixture
def pose(scene, problem):
    R = scene.true.rotation.T
    return R, R @ (problem[1] - scene.true.translation)


def quadratic(steps, hessian, gradient=None):
    """Scores whose half has this Hessian."""
    slope = np.zeros(6) if gradient is None else gradient
    return 0.7 + steps @ slope + np.einsum("ki,ij,kj->k", steps, hessian, steps)


@pytest.fixture
def hessian():
    half = np.random.default_rng(0).standard_normal((6, 6))
    return half @ half.T + np.eye(6)


def test_a_quadratic_cost_has_the_curvature_of_its_hessian(hessian):
    steps = curvature_steps(np.diag([4.0, 1.0, 9.0, 1.0, 2.0, 3.0]), 0.1)
    assert curvature_ratio(quadratic(steps, hessian), steps, hessian) == pytest.approx(1.0)
    sloped = quadratic(steps, 0.3 * hessian, np.arange(6.0))
    assert curvature_ratio(sloped, steps, hessian) == pytest.approx(0.3)


def test_each_step_moves_the_image_by_the_wanted_distance(problem, pose):
    level, _ = problem
    x, before = project(level, *pose)
    steps = curvature_steps(mean_motion(projection_jacobian(level, x, pose[1])), 0.15)
    for R, t in zip(*(a[1:] for a in retractions(*pose, steps)), strict=True):
        moved = project(level, R, t)[1] - before
        assert np.sqrt((moved**2).sum(axis=1).mean()) == pytest.approx(0.15, rel=0.01)


def summed(level, pose, count):
    """Sums over about `count` of the level's anchors, as `JNGO` makes them."""
    few, total = subsample_anchors(level, count), level.points.shape[1]
    sums = covariance_sums(anchor_model(few, *pose, SETTINGS, 16.0))
    assert sums is not None
    return replace(sums, anchors=total, share=few.points.shape[1] / total)


def test_few_anchors_count_for_less_than_their_noise_says(problem, pose):
    sums = summed(problem[0], pose, 10_000)
    many, few = (
        sandwich_covariance(replace(sums, anchors=n), replace(PLAIN, few_anchors=150.0))
        for n in (1_500_000, 150)
    )
    assert many is not None
    np.testing.assert_allclose(few, 2.0 * many, rtol=1e-3)


def test_distances_between_poses_are_those_of_the_image(scene, problem, pose):
    level, _ = problem
    x, before = project(level, *pose)
    motion = mean_motion(projection_jacobian(level, x, pose[1]))
    true = scene.true
    shift = np.array([1.0, -0.5, 0.8])
    other = Pose(so3_exp([0.01, -0.02, 0.015]) @ true.rotation, true.translation + shift)
    differences = pose_differences(other.rotation[None], other.translation[None], true)
    R = other.rotation.T
    after = project(level, R, R @ (problem[1] - other.translation))[1]
    expected = np.sqrt(((after - before) ** 2).sum(axis=1).mean())
    assert image_gap_px(differences, *pose, motion)[0] == pytest.approx(expected, rel=0.05)


def test_only_other_modes_share_the_probability():
    scores = np.array([0.30, 0.30, 0.31, 0.90])
    everything = mode_probabilities(scores, 60, np.array([False, True, True, True]))
    assert everything[0] == pytest.approx(everything[1])
    assert everything[1] > everything[2] > everything[3]
    assert everything.sum() == pytest.approx(1.0)
    near = mode_probabilities(scores, 60, np.array([False, False, True, True]))
    assert near[1] == 0.0
    assert near.sum() == pytest.approx(1.0)
