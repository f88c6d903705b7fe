"""The whole optimizer: convergence, statuses, covariance, priors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from localizer.geometry.pose import Pose, so3_exp, so3_log
from localizer.registration.anchors import select_anchors
from localizer.registration.config import JNGOConfig
from localizer.registration.jngo import JNGO
from localizer.registration.priors import attitude_constraint, height_constraint
from localizer.types import FeatureLevel, RegistrationStatus


@pytest.fixture(scope="module")
def jngo():
    return JNGO(threads=2)


def errors(registration, true):
    return np.concatenate(
        [
            true.translation - registration.world_from_camera.translation,
            so3_log(true.rotation @ registration.world_from_camera.rotation.T),
        ]
    )


@pytest.mark.parametrize("seed", range(6))
def test_converges_from_the_papers_box(jngo, scene_factory, prior, seed):
    scene = scene_factory(seed, 8.0, 8.0)
    result = jngo.register(
        scene.query, scene.camera, scene.anchors, prior(scene.reference, 4.0, 5.0)
    )
    assert result.status is RegistrationStatus.OK
    distance, angle = result.world_from_camera.distance_to(scene.true)
    assert distance < 0.5  # 118 m above ground, 0.8 m per pixel
    assert angle < 0.2
    assert result.quality > 0.7
    assert result.overlap > 0.4


def test_swarm_reaches_what_one_hypothesis_does_not(scene_factory, prior):
    """The paper's Table 4: rotation-aware sampling is what bridges large rotations."""
    single = JNGO(JNGOConfig(hypotheses=1, survivors=(1, 1)))
    swarm = JNGO()
    reached = {"single": 0, "swarm": 0}
    for seed in range(12):
        scene = scene_factory(100 + seed, 3.0, 9.0)
        for name, optimizer in (("single", single), ("swarm", swarm)):
            result = optimizer.register(
                scene.query, scene.camera, scene.anchors, prior(scene.reference, 2.0, 5.0)
            )
            reached[name] += result.world_from_camera.distance_to(scene.true)[0] < 1.0
    assert reached["swarm"] == 12
    assert reached["single"] <= 8


def test_a_coarsest_level_that_is_shifted_does_not_lose_a_right_start(place, scene_factory, prior):
    """As over a park under the shadows of another hour. The finer levels capture less than the
    coarsest level's error: every refined hypothesis is too far away for them.
    """
    shortest = place.waves[2] * np.array([1.5, 1.5, 1.0])
    fine = replace(place, waves=(place.waves[0], shortest, shortest))
    for seed in range(700, 708):
        scene = scene_factory(seed, 0.5, 0.5, at=fine)
        beside = replace(scene.true, translation=scene.true.translation + np.array([10.0, 0, 0]))
        shifted = fine.pyramid(beside, scene.camera, 0.05, seed).levels[0]
        query = replace(scene.query, levels=(shifted, *scene.query.levels[1:]))
        about = prior(scene.reference, 0.7, 0.5)
        result = JNGO().register(query, scene.camera, scene.anchors, about)
        assert result.world_from_camera.distance_to(scene.true)[0] < 0.5


def test_draws_reach_a_place_that_the_swarm_does_not(scene_factory, prior):
    """Metres beside at 110 m above ground, which the swarm's grid of angles does not stand for."""
    reached = {0: 0, 2048: 0}
    for seed in range(8):
        scene = scene_factory(500 + seed, 40.0, 4.0)
        for draws in reached:
            result = JNGO(JNGOConfig(preselected=draws)).register(
                scene.query, scene.camera, scene.anchors, prior(scene.reference, 16.0, 2.0)
            )
            reached[draws] += result.world_from_camera.distance_to(scene.true)[0] < 1.0
    assert reached[2048] == 8
    assert reached[0] <= 5


@pytest.mark.parametrize("count", [1, 2, 5, 144])
def test_a_narrow_prior_draws_nothing_and_a_wide_one_any_number(scene, prior, count):
    drawing = JNGO(JNGOConfig(hypotheses=count, preselected=count))
    plain = JNGO(JNGOConfig(hypotheses=count, preselected=0))
    arguments = (scene.query, scene.camera, scene.anchors)
    poses = [o.register(*arguments, prior(scene.reference, 1.9, 1.5)) for o in (drawing, plain)]
    np.testing.assert_array_equal(*(p.world_from_camera.matrix for p in poses))
    found = drawing.register(*arguments, prior(scene.reference, 2.1, 1.5))
    assert found.status is RegistrationStatus.OK


def test_a_prior_wider_than_a_view_draws_nothing(scene, prior):
    """A whole map is for the search: one view's match with what lies 100 m away is chance."""
    arguments = (scene.query, scene.camera, scene.anchors, prior(scene.reference, 51.0, 5.0))
    drawing, plain = JNGO(), JNGO(JNGOConfig(preselected=0))
    poses = [o.register(*arguments).world_from_camera.matrix for o in (drawing, plain)]
    np.testing.assert_array_equal(*poses)


def test_draws_that_all_look_elsewhere_leave_the_swarm(scene, prior):
    """No draw of a prior of kilometres sees the anchors; the swarm about its middle does."""
    anywhere = JNGO(JNGOConfig(preselected_to_m=1e4))
    about = prior(scene.reference, 9e3, 5.0)
    result = anywhere.register(scene.query, scene.camera, scene.anchors, about)
    assert result.world_from_camera.distance_to(scene.true)[0] < 0.5


def test_more_anchors_sharpen_the_winner(jngo, place, camera, scene_factory, prior):
    errors_by_count: dict[int, list[Any]] = {150: [], 1500: []}
    for seed in range(6):
        scene = scene_factory(300 + seed, 1.0, 1.0)
        view = place.view(scene.reference, camera)
        features = place.pyramid(scene.reference, camera, 0.1, seed)
        query = place.pyramid(scene.true, camera, 0.1, seed + 50)
        for count, found in errors_by_count.items():
            anchors = select_anchors(view, features, count)
            result = jngo.register(query, camera, anchors, prior(scene.reference, 1.0, 1.0))
            found.append(result.world_from_camera.distance_to(scene.true)[0])
    assert np.median(errors_by_count[1500]) < 0.6 * np.median(errors_by_count[150])


def test_same_seed_same_bits(jngo, scene, prior):
    about = prior(scene.reference, 1.0, 3.0)
    arguments = (scene.query, scene.camera, scene.anchors, about)
    a, b = jngo.register(*arguments, seed=3), jngo.register(*arguments, seed=3)
    np.testing.assert_array_equal(a.world_from_camera.matrix, b.world_from_camera.matrix)
    np.testing.assert_array_equal(a.covariance, b.covariance)


def test_covariance_matches_the_errors(scene_factory, prior):
    """Normalised estimation error squared: 6 if calibrated; most runs within its 95 % bound.

    The noise of the 300 anchors is independent here and the map exact, so nothing is left for the
    factors.
    """
    jngo = JNGO(JNGOConfig(correlation=1.0, few_anchors=0.0))
    nees = []
    for seed in range(24):
        scene = scene_factory(200 + seed, 1.0, 1.0)
        result = jngo.register(
            scene.query, scene.camera, scene.anchors, prior(scene.reference, 1.0, 1.0)
        )
        d = errors(result, scene.true)
        nees.append(d @ np.linalg.solve(result.covariance, d))
    assert 3.0 < np.mean(nees) < 9.0
    assert np.mean(np.array(nees) < 12.59) > 0.85


def test_the_covariance_knows_how_many_anchors_were_used(scene, prior):
    about = prior(scene.reference, 1.0, 1.0)

    def covariance(few_anchors):
        jngo = JNGO(JNGOConfig(few_anchors=few_anchors))
        return jngo.register(scene.query, scene.camera, scene.anchors, about).covariance

    growth = np.trace(covariance(300.0)) / np.trace(covariance(0.0))
    used = 300.0 / (growth - 1.0)
    assert 0.7 * len(scene.anchors.points_world) < used <= len(scene.anchors.points_world) + 1e-6


def test_sums_over_fewer_anchors_do_not_change_the_covariance(scene, prior, jngo, monkeypatch):
    about = prior(scene.reference, 1.0, 1.0)
    arguments = (scene.query, scene.camera, scene.anchors, about)
    every = jngo.register(*arguments).covariance
    monkeypatch.setattr("localizer.registration.jngo._COVARIANCE_ANCHORS", 75)
    fourth = jngo.register(*arguments).covariance
    ratio = np.exp((np.linalg.slogdet(fourth)[1] - np.linalg.slogdet(every)[1]) / 6)
    assert 0.5 < ratio < 2.0  # 4 if a fourth of the noise were taken for all of it


def failed(result, about, status):
    assert result.status is status
    assert result.world_from_camera is about.world_from_camera
    np.testing.assert_array_equal(result.covariance, about.covariance)
    assert np.isinf(result.score)
    assert result.quality == 0.0


def test_all_anchors_behind_the_camera(jngo, scene, prior):
    back = Pose(scene.true.rotation @ np.diag([1.0, -1.0, -1.0]), scene.true.translation)
    about = prior(back, 1.0, 1.0)
    result = jngo.register(scene.query, scene.camera, scene.anchors, about)
    failed(result, about, RegistrationStatus.NO_OVERLAP)


def constant(pyramid):
    flat = np.zeros(16, np.float32)
    flat[0] = 1.0
    levels = tuple(
        replace(level, features=np.ascontiguousarray(np.broadcast_to(flat, level.features.shape)))
        for level in pyramid.levels
    )
    return replace(pyramid, levels=levels)


def test_query_without_texture(jngo, scene, prior):
    about = prior(scene.reference, 1.0, 1.0)
    result = jngo.register(constant(scene.query), scene.camera, scene.anchors, about)
    failed(result, about, RegistrationStatus.NO_TEXTURE)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["query", "confidence", "anchors", "points"])
def test_features_that_are_not_finite(jngo, scene, prior, value, where):
    query, anchors = scene.query, scene.anchors
    if where in ("query", "confidence"):
        name = "features" if where == "query" else "confidence"
        broken = getattr(query.levels[1], name).copy()
        broken[5, 7] = value
        levels = (query.levels[0], replace(query.levels[1], **{name: broken}), query.levels[2])
        query = replace(query, levels=levels)
    elif where == "anchors":
        broken = anchors.features[2].copy()
        broken[3] = value
        anchors = replace(anchors, features=(*anchors.features[:2], broken))
    else:
        points = anchors.points_world.copy()
        points[0, 1] = value
        anchors = replace(anchors, points_world=points)
    about = prior(scene.reference, 1.0, 1.0)
    result = jngo.register(query, scene.camera, anchors, about)
    failed(result, about, RegistrationStatus.BAD_FEATURES)


def test_too_few_anchors(jngo, scene, prior):
    a = scene.anchors
    few = replace(
        a,
        points_world=a.points_world[:20],
        pixels=a.pixels[:20],
        features=tuple(f[:20] for f in a.features),
        confidence=tuple(c[:20] for c in a.confidence),
    )
    about = prior(scene.reference, 1.0, 1.0)
    result = jngo.register(scene.query, scene.camera, few, about)
    failed(result, about, RegistrationStatus.TOO_FEW_ANCHORS)


def test_quality_tells_another_place_from_this_one(jngo, scene, prior, place, camera):
    about = prior(scene.reference, 1.0, 2.0)
    right = jngo.register(scene.query, camera, scene.anchors, about)
    elsewhere = Pose(scene.true.rotation, scene.true.translation + np.array([900.0, 700.0, 0.0]))
    wrong = jngo.register(place.pyramid(elsewhere, camera), camera, scene.anchors, about)
    assert right.quality > wrong.quality + 0.3


def repeating(place, period):
    """The place made flat, with features that repeat every `period` metres both ways."""
    rng = np.random.default_rng(0)
    waves = []
    for _ in range(3):
        k = 2 * np.pi / period * rng.integers(-1, 2, (2, 16, 6))
        waves.append(np.stack([*k, rng.uniform(0, 2 * np.pi, (16, 6))], axis=-1))
    return replace(place, hills=np.zeros((1, 4)), waves=tuple(waves))


def test_motion_term_chooses_between_equal_modes(place, camera, prior):
    """On a repeating ground two poses one period apart score the same; Eq. 10 decides."""
    period = 24.0
    ground = repeating(place, period)
    nadir = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 110.0]))
    anchors = select_anchors(ground.view(nadir, camera), ground.pyramid(nadir, camera), 300)
    query = ground.pyramid(nadir, camera, noise=0.1, seed=1)
    jngo = JNGO(JNGOConfig(translation_sigma_m=10.0, spread_sigmas=0.1, step_deg=0.02))
    midway = Pose(nadir.rotation, nadir.translation + np.array([0.5 * period, 0.0, 0.0]))
    for mode_x in (0.0, period):
        mode = nadir.translation + np.array([mode_x, 0.0, 0.0])
        motion = prior(Pose(nadir.rotation, mode), 4.0, 3.0)
        result = jngo.register(query, camera, anchors, prior(midway, 10.0, 1.0), motion=motion)
        assert np.linalg.norm(result.world_from_camera.translation - mode) < 1.0


def test_a_height_constraint_pulls_the_height(jngo, scene, prior):
    about = prior(scene.reference, 1.0, 1.0)
    arguments = (scene.query, scene.camera, scene.anchors, about)
    free = jngo.register(*arguments)
    wanted = free.world_from_camera.translation[2] + 2.0
    held = jngo.register(*arguments, constraint=height_constraint(wanted, 0.01))
    assert held.world_from_camera.translation[2] == pytest.approx(wanted, abs=0.2)
    assert held.covariance[2, 2] < free.covariance[2, 2]
    loose = jngo.register(*arguments, constraint=height_constraint(wanted, 1000.0))
    distance, _ = loose.world_from_camera.distance_to(free.world_from_camera)
    assert distance < 0.02


def test_an_attitude_constraint_pulls_the_attitude(jngo, scene, prior):
    arguments = (scene.query, scene.camera, scene.anchors, prior(scene.reference, 1.0, 1.0))
    turned = so3_exp([0.0, 0.0, 0.01]) @ scene.true.rotation
    held = jngo.register(*arguments, constraint=attitude_constraint(turned, 1e-5, 1e-5))
    angle = so3_log(held.world_from_camera.rotation @ turned.T)
    assert np.linalg.norm(angle) < 1e-3


def test_the_detail_level_sharpens_the_winner(jngo, place, camera, scene_factory, prior):
    """A level more than `iterations`, of stride 1: the search ignores it, the winner ends on it."""
    found: dict[str, list[Any]] = {"without": [], "with": []}
    for seed in range(5):
        scene = scene_factory(500 + seed, 1.0, 1.0)
        detailed, coarse = (
            replace(p, levels=(*p.levels, detail_of(place, camera, pose, seed + k)))
            for k, (p, pose) in enumerate(
                [(scene.query, scene.true), (place.pyramid(scene.reference, camera, 0.05, seed),
                                             scene.reference)]
            )
        )  # fmt: skip
        anchors = select_anchors(place.view(scene.reference, camera), coarse, 1500)
        about = prior(scene.reference, 1.0, 1.0)
        result = jngo.register(detailed, camera, anchors, about)
        found["with"].append(result.world_from_camera.distance_to(scene.true)[0])
        plain = replace(anchors, features=anchors.features[:3], confidence=anchors.confidence[:3])
        result = jngo.register(scene.query, camera, plain, about)
        found["without"].append(result.world_from_camera.distance_to(scene.true)[0])
    assert np.median(found["with"]) < 0.6 * np.median(found["without"])


def detail_of(place, camera, pose, seed):
    """A stride 1 level of the place's finest features, with little noise."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    pixels = np.stack([u, v], axis=-1)
    point = pose.apply(camera.rays(pixels) * place.hit(pose, camera, pixels)[..., None])
    f = place.features(2, point[..., 0], point[..., 1])
    f += 0.01 * np.random.default_rng(seed).standard_normal(f.shape)
    return FeatureLevel(f.astype(np.float32), np.full(f.shape[:2], 0.8, np.float32), 1)
