"""Uncertainty of a registered pose (docs/explanation/registration.md, section 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from localizer.geometry.pose import Array, Pose, scaled_inverse
from localizer.registration.backend import LevelProblem, LMSettings
from localizer.registration.cpu.reference import pose_tangent_map, prior_terms, robust_loss
from localizer.registration.sampling import (
    numbered,
    projection_jacobians,
    seen_anchors,
    structure_tensors,
)

_LEAST_CURVATURE = 0.03


@dataclass(frozen=True)
class AnchorModel:
    """Inputs of the covariance from the residual of each anchor in view (equations 2 to 7).

    projection: (N, 2, 6) of equation 6; structure: (N, 2, 2) and slope: (N, 2), S and b of equation
    7; squares: (N,) squared residual norms; weights: (N,) joint confidences; robust: (N,) the
    loss's weights; cell: (N,) number of its image cell, from 0 on; channels: C; prior_hessian: (6,
    6).
    """

    projection: Array
    structure: Array
    slope: Array
    squares: Array
    weights: Array
    robust: Array
    cell: NDArray[np.int64]
    channels: int
    prior_hessian: Array


def anchor_model(
    problem: LevelProblem,
    rotation: Array,
    translation: Array,
    settings: LMSettings,
    cell_px: float,
) -> AnchorModel:
    """The model of the anchors in view at a pose camera_from_local; cell_px: side of a cell."""
    seen = seen_anchors(problem, rotation, translation)
    anchors = problem.anchor_features[seen.anchor]
    structure, slope, squares = structure_tensors(problem.features, anchors, seen.u, seen.v)
    prior_hessian = np.zeros((6, 6))
    if problem.prior is not None:
        _, prior_hessian, _ = prior_terms(problem.prior, rotation, translation)
    return AnchorModel(
        projection_jacobians(problem, seen.x, translation),
        structure,
        slope,
        squares,
        problem.anchor_confidence[seen.anchor] * seen.confidence,
        robust_loss(np.sqrt(squares), settings)[1],
        _cells(seen.u, seen.v, cell_px),
        anchors.shape[1],
        prior_hessian,
    )


def _cells(u: Array, v: Array, side: float) -> NDArray[np.int64]:
    across = int(u.max(initial=0.0) // side) + 1
    key = (v // side).astype(np.int64) * across + (u // side).astype(np.int64)
    return numbered(key)[0]


@dataclass(frozen=True)
class CovarianceSums:
    """Sums of equation 11 over the anchors in view. hessian: Σ ŵ JᵀSJ, without the prior; meat:
    Σ_cells F Fᵀ; isotropic: Σ ŵ² σ_r² JᵀSJ, all (6, 6); cells: number of occupied cells;
    prior_hessian: (6, 6); motion: (6, 6), mean of JᵀJ, so that xi moves the image by
    sqrt(xi' motion xi) level px, rms; anchors: number in view, of all that the pose was fitted to;
    share: share of these that the sums contain; curvature: equation 11a.
    """

    hessian: Array
    meat: Array
    isotropic: Array
    cells: int
    prior_hessian: Array
    motion: Array
    anchors: int
    share: float = 1.0
    curvature: float = 1.0


def covariance_sums(model: AnchorModel) -> CovarianceSums | None:
    """The sums of an anchor model; None if no anchor has weight."""
    scale = model.weights * model.robust
    total = model.weights.sum()
    if not total > 0:
        return None
    J, S = model.projection, model.structure
    share = (scale / total)[:, None, None]
    rows = J.reshape(-1, 6)  # whole matrices: of each anchor's small ones NumPy makes a call each
    information = share * (S[:, :, :1] * J[:, :1] + S[:, :, 1:] * J[:, 1:])
    pull = share * model.slope[:, :, None]
    per_anchor = pull[:, 0] * J[:, 0] + pull[:, 1] * J[:, 1]
    cells = int(model.cell.max()) + 1
    per_cell = np.zeros((cells, 6))
    np.add.at(per_cell, model.cell, per_anchor)
    variance = scale @ model.squares / max(scale.sum(), 1e-12) / model.channels
    return CovarianceSums(
        rows.T @ information.reshape(-1, 6),
        per_cell.T @ per_cell,
        variance * (rows.T @ (share * information).reshape(-1, 6)),
        cells,
        model.prior_hessian,
        mean_motion(J),
        len(J),
    )


def mean_motion(projection: Array) -> Array:
    """Mean of JᵀJ (6, 6) of the rows (N, 2, 6) of equation 6, in px²."""
    rows = projection.reshape(-1, 6)
    motion: Array = rows.T @ rows / max(len(projection), 1)
    return motion


def curvature_steps(motion: Array, distance_px: float) -> Array:
    """(13, 6) values of xi: zero, then each axis by plus and by minus distance_px in the image."""
    reach = np.diag(distance_px / np.sqrt(np.maximum(np.diag(motion), 1e-12)))
    return np.concatenate([np.zeros((1, 6)), reach, -reach])


def curvature_ratio(scores: Array, steps: Array, hessian: Array) -> float:
    """Measured curvature of the cost divided by that of H, mean over the axes (equation 11a).

    scores: (13,) at `curvature_steps`, without a prior; axes along which the overlap ends are left
    out. At least `_LEAST_CURVATURE`, because on a flat cost only noise is measured.
    """
    if not np.isfinite(scores[0]):
        return _LEAST_CURVATURE
    rise = scores[1:7] + scores[7:] - 2.0 * scores[0]
    expected = 2.0 * np.einsum("ki,ij,kj->k", steps[1:7], hessian, steps[1:7])
    ratios = rise[np.isfinite(rise)] / np.maximum(expected[np.isfinite(rise)], 1e-30)
    return max(float(ratios.mean()), _LEAST_CURVATURE) if len(ratios) else _LEAST_CURVATURE


@dataclass(frozen=True)
class NoiseModel:
    """Assumptions of the covariance about the noise. correlation: variance factor for correlations
    that the sums do not contain (11b); floor: smallest share of the isotropic model, so that a
    perfect fit does not give a zero covariance; few_anchors: number of anchors in view at which the
    variance is doubled (11b); shape_cells: number of cells that count as much as the isotropic
    model (11c).
    """

    correlation: float
    floor: float = 0.0
    few_anchors: float = 0.0
    shape_cells: float = 0.0


def sandwich_covariance(
    sums: CovarianceSums, noise: NoiseModel, prior_weight: float = 0.0
) -> Array | None:
    """Covariance (6, 6) of xi = (rho, phi) at the optimum; None if it is not determined (H is
    singular, or 6 image cells or fewer have anchors).

    It is the sandwich estimator of equation 11. Variance and correlation of the residuals, between
    channels and within an image cell, come from the data. A prior adds noise of its own, by its
    weight `prior_weight`.
    """
    inverse = scaled_inverse(sums.curvature * sums.hessian + sums.prior_hessian)
    if inverse is None or sums.cells <= 6:
        return None
    factor = noise.correlation * sums.share * (1.0 + noise.few_anchors / max(sums.anchors, 1))
    meat = factor * (_shrunk_meat(sums, noise.shape_cells) + noise.floor * sums.isotropic)
    covariance: Array = inverse @ (meat + prior_weight * sums.prior_hessian) @ inverse
    symmetric: Array = 0.5 * (covariance + covariance.T)
    return symmetric


def _shrunk_meat(sums: CovarianceSums, shape_cells: float) -> Array:
    """Equation 11c: the meat, drawn towards the isotropic model of the same size."""
    freedom = sums.cells - 6
    meat = sums.meat * (sums.cells / freedom)
    shape = scaled_inverse(sums.isotropic)
    if shape is None:
        return meat
    ratio = float(np.einsum("ij,ji->", shape, meat)) / 6
    drawn: Array = (freedom * meat + shape_cells * ratio * sums.isotropic) / (freedom + shape_cells)
    return drawn


def pose_covariance(tangent: Array, rotation: Array, translation: Array) -> Array:
    """A tangent covariance (6, 6) converted to `PosePrior`'s (position, left rotation vector; world
    axes), at the pose camera_from_local.
    """
    J = pose_tangent_map(rotation, translation)
    covariance: Array = J @ tangent @ J.T
    symmetric: Array = 0.5 * (covariance + covariance.T)
    return symmetric


def pose_differences(rotations: Array, centres: Array, other: Pose) -> Array:
    """(M, 6) differences of M poses world_from_camera to another (equation 13).

    Position, and rotation vector of ``R R_other'``, in world axes.
    """
    turn = Rotation.from_matrix(rotations @ other.rotation.T).as_rotvec()
    return np.concatenate([centres - other.translation, turn], axis=1)


def image_gap_px(differences: Array, rotation: Array, translation: Array, motion: Array) -> Array:
    """RMS image displacements (M,), in px of the level of `motion`, of poses that differ by
    `differences` (M, 6) from the pose camera_from_local, to first order.
    """
    steps = np.linalg.solve(pose_tangent_map(rotation, translation), differences.T)
    distances: Array = np.sqrt(np.einsum("im,ij,jm->m", steps, motion, steps))
    return distances


def mode_spread(differences: Array, probabilities: Array) -> Array:
    """(6, 6) second moment of competing modes about the chosen pose (equation 14).

    differences: (M, 6) of the modes to the chosen pose, as `pose_differences` returns them;
    probabilities: (M,) of the modes.
    """
    spread: Array = np.einsum("m,mi,mj->ij", probabilities, differences, differences)
    return spread
