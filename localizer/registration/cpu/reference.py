"""Reference backend: the specification in plain float64 NumPy, slow and simple.

Equation numbers are of registration.md. The other backends are tested against it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from localizer.geometry.pose import Array, hat, so3_exp, so3_log
from localizer.registration.backend import (
    LevelProblem,
    LMSettings,
    QuadraticPrior,
    Refinement,
    sample_bilinear,
)
from localizer.types import Float32

MIN_DEPTH = 0.1  # m; anchors nearer than this, or behind, are not in view


@dataclass(frozen=True)
class Linearization:
    """The cost at one pose and its second-order model (equations 4 to 7).

    residuals: (N, C), jacobians: (N, C, 6), weights: (N,) joint confidence, 0 out of view;
    robust: (N,) the loss's weights; score: mean robust cost; hessian: (6, 6) and gradient: (6,) of
    half the score under xi = (rho, phi); visible: (N,).
    """

    residuals: Array
    jacobians: Array
    weights: Array
    robust: Array
    visible: NDArray[np.bool_]
    score: float
    hessian: Array
    gradient: Array


def project(problem: LevelProblem, rotation: Array, translation: Array) -> tuple[Array, Array]:
    """Anchors in the camera frame (N, 3), and their array index coordinates (N, 2) (equation 1)."""
    x = problem.points.T.astype(np.float64) @ rotation.T + translation
    z = np.maximum(x[:, 2:], MIN_DEPTH)
    return x, x[:, :2] / z * np.asarray(problem.focal) + np.asarray(problem.centre)


def in_view(problem: LevelProblem, x: Array, uv: Array) -> NDArray[np.bool_]:
    """Which anchors (N,) lie in front of the camera and between four feature cells. x: (N, 3) in
    the camera frame; uv: (N, 2) array index coordinates, as `project` returns them.
    """
    h, w = problem.confidence.shape
    u, v = uv.T
    inside: NDArray[np.bool_] = (u >= 0) & (u < w - 1) & (v >= 0) & (v < h - 1)
    return inside & (x[:, 2] > MIN_DEPTH)


def count_in_view(problem: LevelProblem, rotation: Array, translation: Array) -> int:
    """Number of anchors in view from the pose camera_from_local."""
    return int(in_view(problem, *project(problem, rotation, translation)).sum())


def feature_gradients(features: Float32, u: Array, v: Array) -> tuple[Array, Array]:
    """Derivatives (N, C), along x and y, of the bilinear interpolation of features (h, w, C) at
    array index coordinates u, v (N,).
    """
    h, w = features.shape[:2]
    x0 = np.clip(np.floor(u).astype(np.int64), 0, w - 2)
    y0 = np.clip(np.floor(v).astype(np.int64), 0, h - 2)
    ax, ay = (u - x0)[:, None], (v - y0)[:, None]
    f00, f01 = (features[y0, x].astype(np.float64) for x in (x0, x0 + 1))
    f10, f11 = (features[y0 + 1, x].astype(np.float64) for x in (x0, x0 + 1))
    gx = (f01 - f00) * (1 - ay) + (f11 - f10) * ay
    gy = (f10 - f00) * (1 - ax) + (f11 - f01) * ax
    return gx, gy


def projection_jacobian(problem: LevelProblem, x: Array, translation: Array) -> Array:
    """d(u, v) / d(rho, phi), (N, 2, 6): equation 6, rotation about the local origin. x: (N, 3)
    anchors in the camera frame; translation: (3,) of camera_from_local.
    """
    fx, fy = problem.focal
    z = np.maximum(x[:, 2], MIN_DEPTH)
    a, b, c, d = fx / z, -fx * x[:, 0] / z**2, fy / z, -fy * x[:, 1] / z**2
    p, q, r = (x - translation).T
    none = np.zeros(len(x))
    columns = [a, none, b, b * q, a * r - b * p, -a * q, none, c, d, d * q - c * r, -d * p, c * p]
    return np.stack(columns, axis=1).reshape(-1, 2, 6)


def linearize(
    problem: LevelProblem, rotation: Array, translation: Array, settings: LMSettings
) -> Linearization:
    """Score, gradient and Gauss-Newton Hessian at one pose camera_from_local."""
    x, uv = project(problem, rotation, translation)
    u, v = uv.T
    visible = in_view(problem, x, uv)
    u, v = np.where(visible, u, 0.0), np.where(visible, v, 0.0)
    residuals = sample_bilinear(problem.features, u, v) - problem.anchor_features
    gx, gy = feature_gradients(problem.features, u, v)
    gradient_uv = np.stack([gx, gy], axis=2)
    jacobians = gradient_uv @ projection_jacobian(problem, x, translation)
    joint = problem.anchor_confidence * sample_bilinear(problem.confidence, u, v)
    weights = np.where(visible, joint, 0.0)
    norm = np.linalg.norm(residuals, axis=1)
    cost, robust = robust_loss(norm, settings)
    total = weights.sum()
    if visible.sum() < minimum_visible(problem, settings) or not total > 0:
        empty = np.zeros((6, 6))
        return Linearization(
            residuals, jacobians, weights, robust, visible, np.inf, empty, np.zeros(6)
        )
    scale = weights * robust / total
    hessian = np.einsum("n,nci,ncj->ij", scale, jacobians, jacobians)
    gradient = np.einsum("n,nci,nc->i", scale, jacobians, residuals)
    score = float(weights @ cost / total)
    if problem.prior is not None:
        extra, H, g = prior_terms(problem.prior, rotation, translation)
        score, hessian, gradient = score + extra, hessian + H, gradient + g
    return Linearization(residuals, jacobians, weights, robust, visible, score, hessian, gradient)


def robust_loss(norm: Array, settings: LMSettings) -> tuple[Array, Array]:
    """Cost and IRLS weight (N,) of residual norms (N,): equation 4."""
    delta = settings.scale
    if settings.redescending:
        share = 1.0 / (1.0 + (norm / delta) ** 2)
        return norm**2 * share, share**2
    cost = np.where(norm <= delta, norm**2, 2 * delta * norm - delta**2)
    return cost, np.where(norm <= delta, 1.0, delta / np.maximum(norm, 1e-12))


def minimum_visible(problem: LevelProblem, settings: LMSettings) -> int:
    """Smallest number of anchors in view with which a pose gets a score."""
    return max(6, int(np.ceil(settings.min_overlap * problem.points.shape[1])))


def pose_tangent_map(rotation: Array, translation: Array) -> Array:
    """d(position, world rotation vector) / d(rho, phi), (6, 6): equation 12."""
    out = np.zeros((6, 6))
    out[:3, :3] = -rotation.T
    out[:3, 3:] = -rotation.T @ hat(translation)
    out[3:, 3:] = -rotation.T
    return out


def prior_terms(
    prior: QuadraticPrior, rotation: Array, translation: Array
) -> tuple[float, Array, Array]:
    """Cost of a `QuadraticPrior` (equation 15) at a pose camera_from_local, and Hessian (6, 6) and
    gradient (6,) of half of it.
    """
    R0, t0 = prior.camera_from_local.rotation, prior.camera_from_local.translation
    d = np.concatenate([R0.T @ t0 - rotation.T @ translation, so3_log(rotation.T @ R0)])
    J = pose_tangent_map(rotation, translation)
    Ld = prior.information @ d
    return (
        float(prior.weight * d @ Ld),
        prior.weight * J.T @ prior.information @ J,
        prior.weight * J.T @ Ld,
    )


def retract(rotation: Array, translation: Array, step: Array) -> tuple[Array, Array]:
    """Equation 5: rotate about the local origin, then translate by step (rho, phi), camera axes."""
    return so3_exp(step[3:]) @ rotation, translation + step[:3]


def retractions(rotation: Array, translation: Array, steps: Array) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) and translations (M, 3) after each of the steps (M, 6)."""
    turns = Rotation.from_rotvec(steps[:, 3:]).as_matrix()
    return np.asarray(turns @ rotation), translation + steps[:, :3]


def damped_step(
    hessian: Array, gradient: Array, translation: Array, damping: float
) -> Array | None:
    """Solution (6,) of the damped normal equations (8): the update (rho, phi). None if they are
    singular. hessian: (6, 6), gradient: (6,), translation: (3,) of camera_from_local, damping:
    lambda.
    """
    if not np.all(np.diag(hessian) > 0):
        return None
    about_camera = np.eye(6)  # of equation 8a: updates about the camera's centre
    about_camera[:3, 3:] = hat(translation)
    back = np.linalg.inv(about_camera)
    metric = np.diag(np.diag(back.T @ hessian @ back))
    H = hessian + damping * about_camera.T @ metric @ about_camera
    scale = 1.0 / np.sqrt(np.diag(H))
    try:
        L = np.linalg.cholesky(H * np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return None
    step: Array = -scale * np.linalg.solve(L.T, np.linalg.solve(L, scale * gradient))
    return step


class ReferenceBackend:
    """Levenberg-Marquardt with accept and reject, one hypothesis after the other."""

    name = "reference (NumPy, float64)"

    def refine(
        self,
        problem: LevelProblem,
        rotations: Array,
        translations: Array,
        iterations: int,
        settings: LMSettings,
    ) -> Refinement:
        """See `Backend.refine`."""
        R, t = rotations.copy(), translations.copy()
        scores, overlaps = np.empty(len(R)), np.empty(len(R))
        evaluations = 0
        for m in range(len(R)):
            R[m], t[m], best, n = _refine_one(problem, R[m], t[m], iterations, settings)
            scores[m], overlaps[m] = best.score, best.visible.mean()
            evaluations += n
        return Refinement(R, t, scores, overlaps, evaluations)


def _refine_one(
    problem: LevelProblem, R: Array, t: Array, iterations: int, settings: LMSettings
) -> tuple[Array, Array, Linearization, int]:
    best = linearize(problem, R, t, settings)
    damping, evaluations = settings.damping, 1
    for _ in range(iterations):
        step = damped_step(best.hessian, best.gradient, t, damping)
        if step is None:
            break
        R_trial, t_trial = retract(R, t, step)
        trial = linearize(problem, R_trial, t_trial, settings)
        evaluations += 1
        if trial.score < best.score:
            R, t, best = R_trial, t_trial, trial
            damping *= settings.damping_down
        else:
            damping *= settings.damping_up
    return R, t, best, evaluations
