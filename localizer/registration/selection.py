"""Selection of hypotheses between refinements (registration.md, 7): distinct modes, their
probability, quality and residuals.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.registration.backend import LevelProblem, LMSettings
from localizer.registration.cpu.reference import robust_loss
from localizer.registration.sampling import sample_features, seen_anchors
from localizer.types import Float32

LEAST_SCORE = 1e-3  # unit of the motion term and of priors where features fit perfectly
_PROBES = 12  # anchors whose projections tell hypotheses apart


def mode_probabilities(scores: Array, cells: int, other: NDArray[np.bool_]) -> Array:
    """Posterior weight (M,) of each surviving mode (equation 14). cells: number of image cells.

    other: (M,) whether it is another mode than the first, and not on the way to it.
    """
    excess = np.maximum(scores - scores[0], 0.0) / max(scores[0], LEAST_SCORE)
    likelihood = np.exp(-0.5 * cells * excess) * other
    likelihood[0] = 1.0
    probabilities: Array = likelihood / likelihood.sum()
    return probabilities


def subsample_anchors(problem: LevelProblem, count: int) -> LevelProblem:
    """The problem with about `count` of its anchors, evenly spread (every k-th in Morton order)."""
    step = problem.points.shape[1] // max(count, 1)
    if step < 2:
        return problem
    return replace(
        problem,
        points=np.ascontiguousarray(problem.points[:, ::step]),
        anchor_features=np.ascontiguousarray(problem.anchor_features[::step]),
        anchor_confidence=np.ascontiguousarray(problem.anchor_confidence[::step]),
    )


def suppress_duplicates(
    problem: LevelProblem, R: Array, t: Array, totals: Array, distance_px: float
) -> NDArray[np.int64]:
    """Indices of finite hypotheses, best first, without near copies of better ones; the best one
    alone if none is finite.

    R (M, 3, 3), t (M, 3): camera_from_local; totals: (M,) cost. Distance: rms over probe anchors of
    the distance between projections, in pixels of the level. Without this the survivors would be
    many copies of one mode.
    """
    order = np.argsort(totals, kind="stable")
    finite = order[np.isfinite(totals[order])]
    if len(finite) < 2:
        return order[:1]
    probes = problem.points[:, :: max(1, problem.points.shape[1] // _PROBES)].astype(np.float64)
    x = R[finite] @ probes + t[finite, :, None]
    z = np.maximum(x[:, 2], 0.1)
    uv = np.concatenate([problem.focal[0] * x[:, 0] / z, problem.focal[1] * x[:, 1] / z], axis=1)
    kept: list[int] = []
    limit = distance_px**2 * uv.shape[1] / 2
    alive = np.ones(len(finite), dtype=bool)
    for i in range(len(finite)):
        if alive[i]:
            kept.append(i)
            alive &= ((uv - uv[i]) ** 2).sum(axis=1) > limit
    return finite[kept]


def _sampled(problem: LevelProblem, R: Array, t: Array) -> tuple[Float32, Float32, Array]:
    """Query and anchor features (n, C) and joint weights (n,) of the anchors in view."""
    seen = seen_anchors(problem, R, t)
    query = sample_features(problem.features, seen.u, seen.v)
    weights = problem.anchor_confidence[seen.anchor] * seen.confidence
    return query, problem.anchor_features[seen.anchor], weights


def quality(problem: LevelProblem, R: Array, t: Array, settings: LMSettings) -> float:
    """Registration quality, 0 to 1, at a pose camera_from_local (R (3, 3), t (3,)): 1 - cost /
    chance cost. For the chance cost each anchor is compared with another anchor's query feature.
    """
    query, reference, weights = _sampled(problem, R, t)
    others = np.roll(reference, len(reference) // 2, axis=0)
    actual, _ = robust_loss(np.linalg.norm(query - reference, axis=1), settings)
    chance, _ = robust_loss(np.linalg.norm(query - others, axis=1), settings)
    return float(np.clip(1.0 - float(weights @ actual) / max(float(weights @ chance), 1e-12), 0, 1))


def median_residual(problem: LevelProblem, R: Array, t: Array) -> float:
    """Weighted median of the residual norms of the anchors in view at a pose camera_from_local (R
    (3, 3), t (3,)). At least one anchor must be in view.
    """
    query, reference, weights = _sampled(problem, R, t)
    norms = np.linalg.norm(query - reference, axis=1)
    order = np.argsort(norms)
    cumulated = np.cumsum(weights[order])
    return float(norms[order][np.searchsorted(cumulated, 0.5 * cumulated[-1])])
