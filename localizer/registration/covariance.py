"""Uncertainty of a registered pose (docs/registration.md, section 8)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from localizer.pose import Array, Pose
from localizer.registration.reference import Linearization, pose_tangent_map


def tangent_covariance(
    model: Linearization, correlation: float, floor: float, prior_weight: float = 0.0
) -> Array | None:
    """Covariance (6, 6) of xi = (rho, phi) at the optimum, None where H is singular.

    The sandwich ``H^-1 (sum_j g_j g_j') H^-1`` (equation 11) uses the residuals' own variance and
    their correlation between channels; `correlation` is the factor for anchors whose features see
    the same image content. `floor` is the least share of the feature noise's isotropic model, so
    that a perfect fit does not claim perfect knowledge. A prior of weight `prior_weight` adds its
    own noise.
    """
    scale = model.weights * model.robust
    total = model.weights.sum()
    per_anchor = np.einsum("nci,nc->ni", model.jacobians, model.residuals) * scale[:, None] / total
    meat = per_anchor.T @ per_anchor
    spread = 1.0 / np.sqrt(np.maximum(np.diag(model.hessian), 1e-300))
    scaled = model.hessian * np.outer(spread, spread)
    values = np.linalg.eigvalsh(scaled)
    if not np.all(np.isfinite(values)) or values[0] < 1e-9:
        return None
    inverse = np.linalg.inv(scaled) * np.outer(spread, spread)
    squares = np.einsum("nc,nc->n", model.residuals, model.residuals)
    channels = model.residuals.shape[1]
    variance = (scale @ squares / max(scale.sum(), 1e-12)) / channels
    isotropic = variance * np.einsum(
        "n,nci,ncj->ij", (scale / total) ** 2, model.jacobians, model.jacobians
    )
    noise = correlation * (meat + floor * isotropic) + prior_weight * model.prior_hessian
    covariance: Array = inverse @ noise @ inverse
    return 0.5 * (covariance + covariance.T)


def pose_covariance(tangent: Array, rotation: Array, translation: Array) -> Array:
    """`PosePrior`'s covariance (position, left rotation vector; world axes) of a tangent one."""
    J = pose_tangent_map(rotation, translation)
    covariance: Array = J @ tangent @ J.T
    return 0.5 * (covariance + covariance.T)


def pose_differences(rotations: Array, centres: Array, other: Pose) -> Array:
    """(M, 6) differences of M poses world_from_camera to another (equation 13).

    Position, and rotation vector of ``R R_other'``, in world axes.
    """
    turn = Rotation.from_matrix(rotations @ other.rotation.T).as_rotvec()
    return np.concatenate([centres - other.translation, turn], axis=1)


def mode_spread(differences: Array, probabilities: Array) -> Array:
    """(6, 6) second moment of competing modes about the chosen pose (equation 14).

    differences: (M, 6) of the modes to the chosen pose.
    """
    spread: Array = np.einsum("m,mi,mj->ij", probabilities, differences, differences)
    return spread
