"""The LM kernel against the reference, emulated and, marked gpu, on the device."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from localizer.geometry.pose import Pose, so3_exp
from localizer.registration.backend import (
    LevelProblem,
    LMSettings,
    QuadraticPrior,
    camera_from_local,
    level_problems,
    local_origin,
    world_from_camera,
)
from localizer.registration.cpu.reference import ReferenceBackend
from localizer.registration.hypotheses import generate_hypotheses

TOLERANCE_M, TOLERANCE_DEG = 1e-3, 1e-3
# Float16 moves a feature's component by up to 2e-4; these are ten times the pose errors seen.


@pytest.fixture(scope="module")
def problems(scene):
    origin = local_origin(scene.anchors, scene.reference)
    return origin, level_problems(scene.query, scene.camera, scene.anchors, origin)


@pytest.fixture(scope="module")
def swarm(scene, problems, prior):
    origin, _ = problems
    R, c = generate_hypotheses(prior(scene.reference, 1.0, 2.0), 18, seed=4)
    return camera_from_local(R, c, origin)


def differences(a, b, origin):
    """Largest distance (m) and angle (degrees) between poses that have a score."""
    np.testing.assert_array_equal(np.isfinite(a.scores), np.isfinite(b.scores))
    first, second = (world_from_camera(x.rotations, x.translations, origin) for x in (a, b))
    finite = np.flatnonzero(np.isfinite(a.scores))
    apart = [
        Pose(first[0][m], first[1][m]).distance_to(Pose(second[0][m], second[1][m])) for m in finite
    ]
    assert apart
    return np.max(apart, axis=0)


def check(backend, problem, swarm, origin, iterations=4, settings=LMSettings()):  # noqa: B008
    exact = ReferenceBackend().refine(problem, *swarm, iterations, settings)
    found = backend.refine(problem, *swarm, iterations, settings)
    distance, angle = differences(exact, found, origin)
    assert distance < TOLERANCE_M
    assert angle < TOLERANCE_DEG
    np.testing.assert_allclose(found.scores, exact.scores, rtol=1e-4)
    np.testing.assert_allclose(found.overlaps, exact.overlaps, atol=1 / 300)
    assert found.evaluations == exact.evaluations


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("settings", [LMSettings(), LMSettings(0.3, redescending=True)])
def test_agrees_with_the_reference(make_backend, problems, swarm, level, settings):
    origin, levels = problems
    check(make_backend(), levels[level], swarm, origin, settings=settings)


def test_agrees_under_a_prior(make_backend, scene, problems, swarm):
    origin, levels = problems
    turned = so3_exp([0.02, -0.03, 0.1]) @ scene.true.rotation
    R, t = camera_from_local(turned[None], scene.true.translation[None] + 3.0, origin)
    A = np.random.default_rng(0).standard_normal((6, 6))
    information = A @ A.T + np.diag([1, 1, 1, 400, 400, 400])
    problem = replace(levels[1], prior=QuadraticPrior(Pose(R[0], t[0]), information, 1e-4))
    backend = make_backend()
    check(backend, problem, swarm, origin, iterations=3)
    without = backend.refine(levels[1], *swarm, 3, LMSettings())
    drawn = backend.refine(problem, *swarm, 3, LMSettings())
    assert np.abs(without.translations - drawn.translations).max() > 0.01


def test_large_steps_turn_as_the_exponential_does(make_backend, problems, swarm):
    """A first guess 40 degrees off makes steps of many degrees; the retraction must stay exact."""
    origin, levels = problems
    R, t = (x[:4].copy() for x in swarm)
    R = so3_exp([0.0, 0.0, 0.7]) @ R
    found = make_backend().refine(levels[0], R, t, 5, LMSettings(min_overlap=0.05))
    orthogonal = found.rotations @ np.swapaxes(found.rotations, 1, 2)
    np.testing.assert_allclose(orthogonal, np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    check(make_backend(), levels[0], (R, t), origin, 5, LMSettings(min_overlap=0.05))


@pytest.mark.parametrize("channels", [5, 24, 64])
def test_any_number_of_channels(make_backend, problems, swarm, channels):
    """One lane an anchor, several vectors a lane, scalar loads: every shape of the inner loop."""
    origin, levels = problems
    rng = np.random.default_rng(channels)
    mix = rng.standard_normal((levels[2].features.shape[-1], channels)).astype(np.float32) / 4
    problem = replace(
        levels[2],
        points=np.ascontiguousarray(levels[2].points[:, :100]),
        features=np.ascontiguousarray(levels[2].features @ mix),
        anchor_features=np.ascontiguousarray(levels[2].anchor_features[:100] @ mix),
        anchor_confidence=levels[2].anchor_confidence[:100],
    )
    few = tuple(x[:6] for x in swarm)
    check(make_backend(), problem, few, origin, iterations=2)


@pytest.mark.parametrize("count", [1, 31, 33, 257])
def test_any_number_of_anchors(make_backend, problems, swarm, count):
    """Part of a warp, part of a block, and more than a block."""
    _, levels = problems
    problem = levels[1]
    problem = replace(
        problem,
        points=np.ascontiguousarray(problem.points[:, :count]),
        anchor_features=problem.anchor_features[:count],
        anchor_confidence=problem.anchor_confidence[:count],
    )
    exact = ReferenceBackend().refine(problem, *swarm, 0, LMSettings())
    found = make_backend().refine(problem, *swarm, 0, LMSettings())
    np.testing.assert_allclose(found.scores, exact.scores, rtol=1e-4)
    assert np.isfinite(found.scores).any() == (count >= 6)


def test_points_behind_the_camera_are_out_of_view(make_backend, scene, problems):
    origin, levels = problems
    back = scene.true.rotation @ np.diag([1.0, -1.0, -1.0])
    R, t = camera_from_local(back[None], scene.true.translation[None], origin)
    found = make_backend().refine(levels[0], R, t, 2, LMSettings())
    assert np.isinf(found.scores[0])
    np.testing.assert_array_equal(found.translations, t)
    assert found.evaluations == 1


def flat(problem: LevelProblem, value: float) -> LevelProblem:
    return replace(problem, features=np.full_like(problem.features, value))


@pytest.mark.parametrize("value", [0.25, np.nan, np.inf])
def test_features_without_information(make_backend, problems, swarm, value):
    """Constant: scored, not moved. Not finite: no score, not moved."""
    _, levels = problems
    found = make_backend().refine(flat(levels[1], value), *swarm, 3, LMSettings())
    np.testing.assert_array_equal(found.translations, swarm[1])
    assert np.isinf(found.scores).all() == (not np.isfinite(value))


def test_zero_confidence_gives_no_score(make_backend, problems, swarm):
    _, levels = problems
    blind = replace(levels[1], confidence=np.zeros_like(levels[1].confidence))
    found = make_backend().refine(blind, *swarm, 3, LMSettings())
    assert np.isinf(found.scores).all()


def test_not_finite_poses_and_points_have_no_score(make_backend, problems, swarm):
    _, levels = problems
    R, t = (x.copy() for x in swarm)
    t[3] = np.nan
    R[5] = np.inf
    found = make_backend().refine(levels[1], R, t, 3, LMSettings())
    assert np.isinf(found.scores[[3, 5]]).all()
    assert np.isfinite(found.scores).sum() > 4
    broken = replace(levels[1], points=np.full_like(levels[1].points, np.nan))
    assert np.isinf(make_backend().refine(broken, *swarm, 3, LMSettings()).scores).all()


def test_same_bits_again_and_other_sizes_between(make_backend, problems, swarm):
    """Buffers are reused: what an earlier, larger problem left in them must not matter."""
    _, levels = problems
    backend = make_backend()
    small = tuple(x[:5] for x in swarm)
    first = backend.refine(levels[0], *small, 3, LMSettings())
    backend.refine(levels[2], *swarm, 3, LMSettings())
    again = backend.refine(levels[0], *small, 3, LMSettings())
    np.testing.assert_array_equal(first.translations, again.translations)
    np.testing.assert_array_equal(first.scores, again.scores)


def test_two_threads_share_a_backend(make_backend, problems, swarm):
    _, levels = problems
    backend = make_backend()
    few = tuple(x[:6] for x in swarm)
    expected = [backend.refine(level, *few, 2, LMSettings()).translations for level in levels]
    wrong = []

    def work(which):
        for _ in range(3):
            found = backend.refine(levels[which], *few, 2, LMSettings()).translations
            if not np.array_equal(found, expected[which]):
                wrong.append(which)

    threads = [threading.Thread(target=work, args=(which,)) for which in (0, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_no_barrier_is_missing(emulator, make_backend, problems, swarm):
    """The bits do not depend on the order in which the threads run between barriers."""
    _, levels = problems
    backend = make_backend()
    few = tuple(x[:2] for x in swarm)
    expected = backend.refine(levels[1], *few, 3, LMSettings())
    assert np.isfinite(expected.scores).all()
    for order in (1, 2, 3):
        emulator.order(order)
        found = backend.refine(levels[1], *few, 3, LMSettings())
        np.testing.assert_array_equal(found.rotations, expected.rotations)
        np.testing.assert_array_equal(found.scores, expected.scores)


def test_buffers_are_allocated_once_and_freed(emulator, make_backend, problems, swarm):
    _, levels = problems
    before = emulator.counts().blocks
    backend = make_backend()
    backend.refine(levels[2], *swarm, 1, LMSettings())
    after_one = emulator.counts()
    for _ in range(3):
        backend.refine(levels[2], *swarm, 1, LMSettings())
    assert emulator.counts().allocations == after_one.allocations
    backend.close()
    assert emulator.counts().blocks == before
