"""The backends against mathematics and against each other."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numba.core.runtime import rtsys

from localizer.geometry.pose import Pose, so3_exp, so3_log
from localizer.registration.backend import (
    LMSettings,
    QuadraticPrior,
    camera_from_local,
    level_problems,
    local_origin,
    sample_bilinear,
    world_from_camera,
)
from localizer.registration.cpu.kernel import NumbaBackend, refine_kernel
from localizer.registration.cpu.reference import (
    ReferenceBackend,
    in_view,
    linearize,
    pose_tangent_map,
    project,
    projection_jacobian,
    retract,
)
from localizer.registration.hypotheses import generate_hypotheses
from localizer.registration.sampling import projection_jacobians, seen_anchors

SETTINGS = LMSettings()
# A busy machine is no reason to fail.
patient = settings(suppress_health_check=[HealthCheck.too_slow])


@pytest.fixture(scope="module")
def problems(scene):
    origin = local_origin(scene.anchors, scene.reference)
    return origin, level_problems(scene.query, scene.camera, scene.anchors, origin)


def local(pose, origin):
    R, t = camera_from_local(pose.rotation[None], pose.translation[None], origin)
    return R[0], t[0]


@pytest.fixture(scope="module")
def swarm(scene, problems, prior):
    origin, _ = problems
    R, c = generate_hypotheses(prior(scene.reference, 1.0, 2.0), 24, seed=4)
    return camera_from_local(R, c, origin)


def test_projection_of_anchors_meets_their_pixels(scene, problems):
    """Level coordinates follow the half-pixel rule: image pixel u is index u / stride - 0.5."""
    origin, levels = problems
    R, t = local(scene.reference, origin)
    for problem, level in zip(levels, scene.query.levels, strict=True):
        _, uv = project(problem, R, t)
        np.testing.assert_allclose((uv + 0.5) * level.stride, scene.anchors.pixels, atol=2e-3)


@pytest.mark.parametrize("border", [0, 6])
def test_compiled_projection_is_the_references(problems, swarm, border):
    """At poses from which some anchors are out of view."""
    problem = problems[1][2]
    h, w = problem.confidence.shape
    for R, t in zip(*swarm, strict=True):
        x, uv = project(problem, R, t)
        inside = in_view(problem, x, uv) & (uv >= border).all(axis=1)
        inside &= (uv < np.array([w, h]) - 1 - border).all(axis=1)
        seen = seen_anchors(problem, R, t, border)
        np.testing.assert_array_equal(seen.anchor, np.flatnonzero(inside))
        np.testing.assert_allclose(seen.x, x[inside], atol=1e-9)
        np.testing.assert_allclose(np.stack([seen.u, seen.v], axis=1), uv[inside], atol=1e-9)
        confidence = sample_bilinear(problem.confidence, *uv[inside].T)
        np.testing.assert_allclose(seen.confidence, confidence, atol=1e-6)
        np.testing.assert_allclose(
            projection_jacobians(problem, seen.x, t),
            projection_jacobian(problem, x[inside], t), rtol=1e-9, atol=1e-9,
        )  # fmt: skip
    assert not inside.all()


def test_feature_jacobians_are_autograds(scene, problems):
    """Equations 1, 3 and 5 written once more, in PyTorch, and differentiated by it."""
    torch = pytest.importorskip("torch")
    origin, levels = problems
    problem = levels[2]
    R, t = local(scene.reference, origin)
    model = linearize(problem, R, t, SETTINGS)
    chosen = np.flatnonzero(model.visible)[::12]
    points = torch.from_numpy(problem.points.T[chosen].astype(np.float64))
    features = torch.from_numpy(problem.features.astype(np.float64))
    focal, centre = (torch.tensor(x, dtype=torch.float64) for x in (problem.focal, problem.centre))
    R0, t0 = torch.from_numpy(R), torch.from_numpy(t)

    def query_features(xi):
        zero = torch.zeros((), dtype=torch.float64)
        a, b, c = xi[3:]
        turn = torch.stack(
            [torch.stack([zero, -c, b]), torch.stack([c, zero, -a]), torch.stack([-b, a, zero])]
        )
        x = points @ (torch.linalg.matrix_exp(turn) @ R0).T + t0 + xi[:3]
        u, v = (x[:, :2] / x[:, 2:] * focal + centre).T
        i, j = u.detach().floor().long(), v.detach().floor().long()
        p, q = (u - i)[:, None], (v - j)[:, None]
        top = features[j, i] * (1 - p) + features[j, i + 1] * p
        low = features[j + 1, i] * (1 - p) + features[j + 1, i + 1] * p
        return top * (1 - q) + low * q

    start = torch.zeros(6, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(query_features, start).numpy()
    assert len(chosen) > 15
    np.testing.assert_allclose(model.jacobians[chosen], jacobian, atol=1e-9)
    residuals = query_features(start).numpy() - problem.anchor_features[chosen]
    np.testing.assert_allclose(model.residuals[chosen], residuals, atol=1e-9)


@patient
@given(
    st.lists(st.floats(-3, 3), min_size=6, max_size=6),
    st.lists(st.floats(-500, 500), min_size=6, max_size=6),
)
def test_a_retraction_is_undone_by_its_opposite(xi, places):
    """exp(-phi) exp(phi) R = R and t + rho - rho = t, for steps of any size below half a turn."""
    step = np.array(xi)
    R, t = so3_exp(np.array(places[:3]) / 500), np.array(places[3:])
    there = retract(R, t, step)
    back = retract(*there, -step)
    np.testing.assert_allclose(back[0], R, atol=1e-12)
    np.testing.assert_allclose(back[1], t, atol=1e-12)
    np.testing.assert_allclose(there[0] @ there[0].T, np.eye(3), atol=1e-12)


@patient
@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.lists(st.floats(-1e4, 1e4), min_size=6, max_size=6),
)
def test_local_frame_round_trip_anywhere(turn, places):
    R, centre, origin = so3_exp(np.array(turn)), np.array(places[:3]), np.array(places[3:])
    there = camera_from_local(R[None], centre[None], origin)
    rotations, centres = world_from_camera(*there, origin)
    np.testing.assert_array_equal(rotations[0], R)
    np.testing.assert_allclose(centres[0], centre, atol=1e-10 * 1e4)


@pytest.mark.parametrize(("scale", "redescending"), [(0.02, False), (0.5, False), (0.2, True)])
def test_gradient_is_that_of_half_the_score(scene, problems, scale, redescending):
    """With the query's confidence constant, the score has no term that the gradient leaves out."""
    origin, levels = problems
    flat = replace(levels[1], confidence=np.full_like(levels[1].confidence, 0.7))
    R, t = local(scene.reference, origin)
    settings = LMSettings(scale, redescending)
    model = linearize(flat, R, t, settings)
    numeric = np.zeros(6)
    for axis, h in enumerate([1e-5] * 3 + [1e-7] * 3):
        step = np.zeros(6)
        step[axis] = h
        plus = linearize(flat, *retract(R, t, step), settings).score
        minus = linearize(flat, *retract(R, t, -step), settings).score
        numeric[axis] = 0.5 * (plus - minus) / (2 * h)
    np.testing.assert_allclose(model.gradient, numeric, rtol=2e-3, atol=1e-7)


def test_pose_tangent_map_against_finite_differences(scene, problems):
    origin, _ = problems
    R, t = local(scene.true, origin)
    analytic = pose_tangent_map(R, t)
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        R2, t2 = retract(R, t, step)
        moved = -R2.T @ t2 + R.T @ t
        turned = so3_log(R2.T @ R)
        numeric = np.concatenate([moved, turned]) / 1e-6
        np.testing.assert_allclose(analytic[:, axis], numeric, atol=2e-4)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("settings", [SETTINGS, LMSettings(0.3, redescending=True)])
def test_numba_agrees_with_the_reference(problems, swarm, level, settings):
    origin, levels = problems
    exact = ReferenceBackend().refine(levels[level], *swarm, 4, settings)
    fast = NumbaBackend(2).refine(levels[level], *swarm, 4, settings)
    np.testing.assert_array_equal(np.isfinite(exact.scores), np.isfinite(fast.scores))
    assert np.isfinite(exact.scores).sum() > 12
    for m in np.flatnonzero(np.isfinite(exact.scores)):
        a = Pose(*(v[0] for v in world_from_camera(
            exact.rotations[m : m + 1], exact.translations[m : m + 1], origin
        )))  # fmt: skip
        b = Pose(*(v[0] for v in world_from_camera(
            fast.rotations[m : m + 1], fast.translations[m : m + 1], origin
        )))  # fmt: skip
        distance, angle = a.distance_to(b)
        assert distance < 1e-3
        assert angle < 1e-3
    np.testing.assert_allclose(fast.scores, exact.scores, rtol=1e-4)
    np.testing.assert_allclose(fast.overlaps, exact.overlaps, atol=1 / 300)
    assert fast.evaluations == exact.evaluations


def test_numba_agrees_with_the_reference_under_a_prior(scene, problems, swarm):
    origin, levels = problems
    target = Pose(*local(Pose(so3_exp([0.02, -0.03, 0.1]) @ scene.true.rotation,
                              scene.true.translation + 3.0), origin))  # fmt: skip
    rng = np.random.default_rng(0)
    A = rng.standard_normal((6, 6))
    prior = QuadraticPrior(target, A @ A.T + np.diag([1, 1, 1, 400, 400, 400]), 1e-4)
    problem = replace(levels[1], prior=prior)
    exact = ReferenceBackend().refine(problem, *swarm, 3, SETTINGS)
    fast = NumbaBackend(2).refine(problem, *swarm, 3, SETTINGS)
    np.testing.assert_allclose(fast.scores, exact.scores, rtol=1e-4)
    np.testing.assert_allclose(fast.translations, exact.translations, atol=1e-3)
    np.testing.assert_allclose(fast.rotations, exact.rotations, atol=2e-5)
    without = NumbaBackend(2).refine(levels[1], *swarm, 3, SETTINGS)
    assert np.abs(without.translations - fast.translations).max() > 0.01


def test_scores_never_rise(problems, swarm):
    _, levels = problems
    backend = NumbaBackend(2)
    before = backend.refine(levels[1], *swarm, 0, SETTINGS).scores
    last = before
    for iterations in (1, 2, 4, 8):
        after = backend.refine(levels[1], *swarm, iterations, SETTINGS).scores
        finite = np.isfinite(last)
        assert np.all(after[finite] <= last[finite])
        last = after
    assert np.median(last) < 0.5 * np.median(before[np.isfinite(before)])


def test_thread_count_does_not_change_a_bit(problems, swarm):
    _, levels = problems
    one = NumbaBackend(1).refine(levels[2], *swarm, 3, SETTINGS)
    two = NumbaBackend(2).refine(levels[2], *swarm, 3, SETTINGS)
    np.testing.assert_array_equal(one.rotations, two.rotations)
    np.testing.assert_array_equal(one.translations, two.translations)
    np.testing.assert_array_equal(one.scores, two.scores)


def test_points_behind_the_camera_are_out_of_view(scene, problems):
    origin, levels = problems
    behind = Pose(scene.true.rotation @ np.diag([1.0, -1.0, -1.0]), scene.true.translation)
    R, t = local(behind, origin)
    for backend in (ReferenceBackend(), NumbaBackend(1)):
        result = backend.refine(levels[0], R[None], t[None], 2, SETTINGS)
        assert np.isinf(result.scores[0])
        np.testing.assert_array_equal(result.translations[0], t)


def test_no_allocation_per_iteration_or_frame(scene, problems, swarm):
    """Iterations allocate nothing, with a prior too; a frame only its results and arguments."""
    origin, levels = problems
    target = Pose(*local(scene.true, origin))
    problem = replace(levels[2], prior=QuadraticPrior(target, np.eye(6), 1e-4))
    backend = NumbaBackend(1)

    def allocations(iterations):
        before = rtsys.get_allocation_stats()
        backend.refine(problem, *swarm, iterations, SETTINGS)
        after = rtsys.get_allocation_stats()
        return after.alloc - before.alloc

    assert allocations(1) > 0  # else the counters are off and the test means nothing
    assert allocations(1) == allocations(12)

    backend.refine(problem, *swarm, 2, SETTINGS)
    tracemalloc.start()
    backend.refine(problem, *swarm, 2, SETTINGS)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    results = sum(a.nbytes for a in swarm) + 3 * 8 * len(swarm[0])
    assert peak < results + 10_000


def test_what_a_kernel_closes_over_is_the_same_in_every_process():
    # Numba finds a compiled closure on disk by its pickled variables: a compiled function among
    # them has a number of its process's own, and everything is compiled anew in each.
    closure = refine_kernel(16).py_func.__closure__  # type: ignore[attr-defined]
    assert [cell.cell_contents for cell in closure] == [16]
