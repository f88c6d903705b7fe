from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from localizer.geometry.pose import Pose, so3_exp
from localizer.registration.hypotheses import draw_hypotheses, generate_hypotheses
from localizer.types import PosePrior


def prior_with(covariance):
    return PosePrior(Pose(so3_exp([2.0, 0.3, -0.4]), np.array([5.0, -3.0, 120.0])), covariance, 0)


def wide():
    return prior_with(np.diag([25.0, 25.0, 25.0, 0.2, 0.2, 0.2]))


def camera_turns(prior, rotations):
    return np.degrees(
        Rotation.from_matrix(prior.world_from_camera.rotation.T @ rotations).as_rotvec()
    )


def test_the_papers_box():
    """Eq. 4: 144 hypotheses, pitch and yaw within 11 degrees, neighbours 2 degrees apart."""
    prior = wide()
    rotations, _ = generate_hypotheses(prior, 144)
    assert len(rotations) == 144
    narrow = prior_with(np.diag([1, 1, 1, 0.2, 0.2, 0.2]))
    # Without rotation about the optical axis the grid can be read off exactly.
    flat = (
        narrow.world_from_camera.rotation
        @ np.diag([0.2, 0.2, 0.0])
        @ (narrow.world_from_camera.rotation.T)
    )
    cov = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    cov[3:, 3:] = flat
    turns = camera_turns(prior, generate_hypotheses(prior_with(cov), 144)[0])
    assert np.abs(turns[:, :2]).max() == pytest.approx(11.0, abs=1e-6)
    assert np.abs(turns[:, 2]).max() < 1e-6
    ticks = np.unique(np.round(turns[1:, 0], 6))
    np.testing.assert_allclose(np.diff(ticks), 2.0, atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 9, 36, 144, 200])
def test_the_unperturbed_prior_is_always_there(count):
    prior = wide()
    rotations, centres = generate_hypotheses(prior, count)
    assert len(rotations) == len(centres) == min(int(np.sqrt(count)), 12) ** 2
    np.testing.assert_allclose(rotations[0], prior.world_from_camera.rotation, atol=1e-14)
    np.testing.assert_array_equal(centres[0], prior.world_from_camera.translation)


def test_spread_follows_the_covariance_per_axis():
    """A camera that knows its pitch to 0.2 degrees and its yaw to 3 searches only the yaw."""
    R = prior_with(np.eye(6)).world_from_camera.rotation
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([0.01, 0.04, 0.0])
    covariance[3:, 3:] = R @ np.diag(np.radians([0.2, 3.0, 0.1]) ** 2) @ R.T
    prior = prior_with(covariance)
    rotations, centres = generate_hypotheses(prior, 144, step_deg=0.1, seed=1)
    turns = camera_turns(prior, rotations)
    assert np.abs(turns[:, 0]).max() < 0.6
    assert 5.5 < np.abs(turns[:, 1]).max() < 7.5
    shifts = centres - prior.world_from_camera.translation
    assert shifts[:, 0].std() == pytest.approx(0.1, rel=0.25)
    assert shifts[:, 1].std() == pytest.approx(0.2, rel=0.25)
    assert np.abs(shifts[:, 2]).max() < 1e-9


def test_draws_have_the_priors_whole_covariance():
    root = np.random.default_rng(0).normal(size=(6, 6)) * np.repeat([2.0, 0.02], 3)[:, None]
    prior = prior_with(root @ root.T)
    rotations, centres = draw_hypotheses(prior, 3000, seed=5)
    pose = prior.world_from_camera
    turns = Rotation.from_matrix(rotations @ pose.rotation.T).as_rotvec()
    spread = np.cov(np.hstack([centres - pose.translation, turns]).T)
    scale = np.sqrt(np.outer(*[np.diag(prior.covariance)] * 2))
    np.testing.assert_allclose(spread / scale, prior.covariance / scale, atol=0.02)
    again = draw_hypotheses(prior, 3000, seed=5)
    np.testing.assert_array_equal(rotations, again[0])
    np.testing.assert_array_equal(centres, again[1])
