from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from localizer.geometry.pose import Pose, so3_exp
from localizer.integrity.acceptance import IntegrityConfig, is_acceptable
from localizer.registration.agreement import agreement
from localizer.registration.backend import camera_from_local, level_problems, local_origin
from localizer.registration.hypotheses import draw_hypotheses, generate_hypotheses
from localizer.registration.jngo import JNGO
from localizer.types import FeatureLevel, PosePrior, RegistrationStatus


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


# --- How the parts of an image vote on a pose: true, wrong, and half of it of another place -----


@pytest.fixture(scope="module")
def jngo():
    return JNGO(threads=1)


def votes_at(scene, pose, query=None):
    """What the finest level's anchors say of a pose world_from_camera."""
    origin = local_origin(scene.anchors, pose)
    level = level_problems(query or scene.query, scene.camera, scene.anchors, origin)[-1]
    R, t = camera_from_local(pose.rotation[None], pose.translation[None], origin)
    return agreement(level, R[0], t[0])


def test_parts_agree_on_the_truth_and_not_on_a_place_elsewhere(scene_factory):
    for seed in range(3):
        scene, other = scene_factory(seed, 2.0, 2.0), scene_factory(seed + 50, 2.0, 2.0)
        right, wrong = votes_at(scene, scene.true), votes_at(scene, scene.true, other.query)
        assert right.patches >= 8
        assert right.share > 0.9
        assert wrong.share < 0.35
        assert right.peak > wrong.peak
        assert right.patch_peak > wrong.patch_peak
        assert right.displacements is not None
        assert wrong.displacements is not None
        assert right.displacements.matched == 1.0
        assert wrong.displacements.matched < 0.5


def test_a_shifted_pose_loses_the_votes(scene_factory):
    """Two level px are 3 m here: what the optimizer would have mended is no agreement."""
    scene = scene_factory(1, 2.0, 2.0)
    moved = replace(scene.true, translation=scene.true.translation + np.array([6.0, 0, 0]))
    assert votes_at(scene, moved).share < 0.3


def test_a_registration_to_another_place_is_refused(jngo, scene_factory, prior):
    config = IntegrityConfig(min_overlap=0.0)
    refused = 0
    for seed in range(4):
        scene, other = scene_factory(seed, 2.0, 2.0), scene_factory(seed + 50, 2.0, 2.0)
        begun = prior(scene.reference, 4.0, 5.0)
        right = jngo.register(scene.query, scene.camera, scene.anchors, begun)
        wrong = jngo.register(other.query, scene.camera, scene.anchors, begun)
        assert is_acceptable(config, right, 0.0)
        if wrong.status is RegistrationStatus.OK:
            assert not is_acceptable(config, wrong, 0.0)
            refused += 1
    assert refused >= 2


def test_the_patches_measure_a_shift_of_the_pose(scene_factory):
    """A camera that is 1 m too far east sees all patches lie where that metre puts them."""
    scene = scene_factory(1, 2.0, 2.0)
    off = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    moved = replace(scene.true, translation=scene.true.translation + off[:3])
    patches = votes_at(scene, moved).displacements
    expected = patches.motion @ -off
    assert len(patches.shift) >= 8
    np.testing.assert_allclose(np.median(patches.shift - expected, axis=0), 0.0, atol=0.15)


def test_ground_that_rises_moves_against_a_camera_that_rises(scene_factory):
    patches = votes_at(scene_factory(1, 2.0, 2.0), scene_factory(1, 2.0, 2.0).true).displacements
    np.testing.assert_allclose(patches.rise, -patches.motion[:, :, 2])


def test_half_a_picture_of_another_place_is_no_majority(scene_factory):
    scene, other = scene_factory(3, 2.0, 2.0), scene_factory(53, 2.0, 2.0)
    levels = []
    for mine, foreign in zip(scene.query.levels, other.query.levels, strict=True):
        features = mine.features.copy()
        half = features.shape[1] // 2
        features[:, half:] = foreign.features[:, half:]
        levels.append(FeatureLevel(features, mine.confidence, mine.stride))
    share = votes_at(scene, scene.true, replace(scene.query, levels=tuple(levels))).share
    assert 0.2 < share < 0.8


def test_without_anchors_in_view_nobody_votes(scene_factory):
    scene = scene_factory(0, 2.0, 2.0)
    turned = replace(scene.true, rotation=scene.true.rotation @ np.diag([1.0, -1.0, -1.0]))
    votes = votes_at(scene, turned)
    assert (votes.patches, votes.votes, votes.share) == (0, 0, 0.0)
