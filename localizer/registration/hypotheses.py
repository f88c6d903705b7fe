"""Rotation-aware pose hypotheses (paper, Eq. 4 and 5; registration.md, section 6)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from localizer.geometry.pose import Array
from localizer.types import PosePrior

_LEAST_TICKS = 3  # per axis, however well the attitude is known


def generate_hypotheses(
    prior: PosePrior,
    count: int = 144,
    *,
    box_deg: float = 11.0,
    step_deg: float = 2.0,
    translation_limit_m: float = 1.0,
    reach: float = 2.2,
    seed: int = 0,
) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) and centres (M, 3) of M <= `count` poses world_from_camera.

    The unperturbed prior is the first one. Rotation about the camera's x axis (pitch) and y axis
    (yaw), which move the whole image: a grid. Its half-width per axis is `reach` standard
    deviations of the prior, at most `box_deg`; its step is at most `step_deg` as long as `count`
    allows. The paper's 144, 11 and 2 degrees give a 12 x 12 grid; a more certain prior gives a
    smaller one. Rotation about the optical axis, and translation: normal with the prior's
    covariance, cut to ``box_deg / reach`` and to `translation_limit_m` per axis. The unperturbed
    prior replaces the grid's farthest corner.
    """
    R = prior.world_from_camera.rotation
    sigma = np.sqrt(np.maximum(np.diag(R.T @ prior.covariance[3:, 3:] @ R), 0.0))
    box = np.radians(box_deg)
    half = np.minimum(box, reach * sigma[:2])
    grid = _grid(half, np.radians(step_deg), count)
    rng = np.random.default_rng(seed)
    offsets = np.zeros((len(grid), 3))
    offsets[1:, :2] = grid[:-1]
    offsets[1:, 2] = rng.normal(0.0, min(sigma[2], box / reach), len(grid) - 1)
    root = _limited_square_root(prior.covariance[:3, :3], translation_limit_m)
    shifts = rng.normal(0.0, 1.0, (len(grid), 3)) @ root.T
    shifts[0] = 0.0
    rotations: Array = R @ Rotation.from_rotvec(offsets).as_matrix()
    return rotations, prior.world_from_camera.translation + shifts


def draw_hypotheses(prior: PosePrior, count: int, seed: int = 0) -> tuple[Array, Array]:
    """Rotations (count, 3, 3) and centres (count, 3) of poses world_from_camera, normal with the
    prior's whole covariance. They come from a scrambled Sobol sequence, which leaves no gaps and
    clusters.
    """
    root = _limited_square_root(prior.covariance, np.inf)
    balanced = 1 << max(count - 1, 0).bit_length()  # the sequence covers evenly in powers of two
    normal = qmc.MultivariateNormalQMC(np.zeros(6), rng=seed).random(balanced)[:count]
    offsets = normal @ root.T
    pose = prior.world_from_camera
    rotations: Array = Rotation.from_rotvec(offsets[:, 3:]).as_matrix() @ pose.rotation
    return rotations, pose.translation + offsets[:, :3]


def _grid(half: Array, step: float, count: int) -> Array:
    """At most `count` points (M, 2), nearest first, of a grid over +-half per axis."""
    most = max(1, int(np.sqrt(count)))
    least = min(_LEAST_TICKS, most)
    counts = np.clip(np.ceil(2 * half / step - 1e-9) + 1, least, most).astype(int)
    return _unit_grid(*counts) * half


@lru_cache(64)
def _unit_grid(*counts: int) -> Array:
    """Points (M, 2), nearest first, of a grid over +-1 per axis."""
    ticks = [np.linspace(-1.0, 1.0, n) if n > 1 else np.zeros(1) for n in counts]
    points = np.stack(np.meshgrid(*ticks), axis=-1).reshape(-1, 2)
    distance = np.round(np.linalg.norm(points, axis=1), 9)
    nearest: Array = points[np.argsort(distance, kind="stable")]
    return nearest


def _limited_square_root(covariance: Array, limit: float) -> Array:
    """A (n, n) square root of a covariance whose axes' deviations are cut to `limit`."""
    values, vectors = np.linalg.eigh(covariance)
    root: Array = vectors * np.minimum(np.sqrt(np.maximum(values, 0.0)), limit)
    return root
