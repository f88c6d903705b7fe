"""Rotation-aware pose hypotheses (paper, Eq. 4 and 5; docs/registration.md, section 6)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from localizer.pose import Array
from localizer.types import PosePrior


def generate_hypotheses(
    prior: PosePrior,
    count: int = 144,
    *,
    box_deg: float = 11.0,
    translation_limit_m: float = 1.0,
    reach: float = 2.2,
    seed: int = 0,
) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) and centres (M, 3) of M = `count` poses world_from_camera.

    The unperturbed prior is the first. Rotation: a square grid over the two axes that move the
    whole image, the camera's x (pitch) and y (yaw). Its half-width per axis is `reach` standard
    deviations of the prior and at most `box_deg`; with the paper's 144 and 11 degrees the step is
    2 degrees. Rotation about the optical axis, and translation: normal with the prior's
    covariance, the deviation cut to ``box_deg / reach`` and `translation_limit_m` per axis. The
    grid's farthest corner gives its place to the zero perturbation.
    """
    R = prior.world_from_camera.rotation
    sigma = np.sqrt(np.maximum(np.diag(R.T @ prior.covariance[3:, 3:] @ R), 0.0))
    box = np.radians(box_deg)
    rng = np.random.default_rng(seed)
    offsets = np.zeros((count, 3))
    offsets[1:, :2] = _grid(count - 1) * np.minimum(box, reach * sigma[:2])
    offsets[1:, 2] = rng.normal(0.0, min(sigma[2], box / reach), count - 1)
    root = _limited_square_root(prior.covariance[:3, :3], translation_limit_m)
    shifts = rng.normal(0.0, 1.0, (count, 3)) @ root.T
    shifts[0] = 0.0
    rotations: Array = R @ Rotation.from_rotvec(offsets).as_matrix()
    return rotations, prior.world_from_camera.translation + shifts


def _grid(count: int) -> Array:
    """The `count` points (count, 2) nearest to 0 of the smallest square grid over [-1, 1]²."""
    side = int(np.ceil(np.sqrt(count)))
    ticks = np.linspace(-1.0, 1.0, side) if side > 1 else np.zeros(1)
    points = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    order = np.argsort(np.round(np.linalg.norm(points, axis=1), 9), kind="stable")
    nearest: Array = points[order[:count]]
    return nearest


def _limited_square_root(covariance: Array, limit: float) -> Array:
    """A (3, 3) square root of a covariance whose axes' deviations are cut to `limit`."""
    values, vectors = np.linalg.eigh(covariance)
    root: Array = vectors * np.minimum(np.sqrt(np.maximum(values, 0.0)), limit)
    return root
