"""Covariance of a registered pose from the displacements of its image's patches (registration.md,
8a).

At the registered pose each patch of the image has a shift under which it matches the map best. If
the map were right everywhere, these shifts would be noise of a fraction of a pixel. Where it is of
another date or sensor they scatter more, and where the map lacks buildings and trees every roof is
displaced by its parallax. Neighbouring patches on one roof err together, so counting anchors as
independent makes a pose look ten times better known than it is.

The pose follows the displacements by least squares, ``xi = (X'X)^-1 X'd``. So its covariance is
``(X'X)^-1 X' W X (X'X)^-1``, where W has two parts: noise that is independent from patch to patch,
measured from the displacements themselves, and heights that the map does not have.
"""

from __future__ import annotations

import numpy as np

from localizer.geometry.pose import Array
from localizer.registration.agreement import PatchDisplacements

LEAST_PATCHES = 8  # six numbers are fitted
_LEAST_PX = 0.05  # of the scatter: a perfect fit is no perfect knowledge
# Both were chosen on fengyuan, with a look at NEON and caliterra; no other town has checked them.
BLOCK_M = 20.0  # over which an unknown height is the same: a building, a row of trees
COMMON = 2.0  # mean of the unknown heights over their spread: buildings stand on the ground
_SINGULAR = 1e-9


def patch_covariance(patches: PatchDisplacements, height_sigma_m: float) -> Array | None:
    """Covariance (6, 6), as `PosePrior`'s, of the pose at which the patches were measured.

    height_sigma_m: spread of the heights that the map does not have; 0 for a surface model. None
    where the patches do not determine a pose.
    """
    if len(patches.shift) < LEAST_PATCHES:
        return None
    rows = patches.motion.reshape(-1, 6)
    normal = rows.T @ rows
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * np.outer(scale, scale)
    if np.linalg.eigvalsh(scaled)[0] < _SINGULAR:
        return None
    inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
    noise_px = max(patches.scatter_px, _LEAST_PX)
    meat = noise_px**2 * normal
    if height_sigma_m > 0:
        pull = np.einsum("kai,ka->ki", patches.motion, patches.rise)
        meat = meat + height_sigma_m**2 * pull.T @ height_correlation(patches.ground) @ pull
    covariance = inverse @ meat @ inverse
    symmetric: Array = 0.5 * (covariance + covariance.T)
    return symmetric


def height_correlation(ground: Array) -> Array:
    """(P, P) covariance of unknown heights at places (P, 2), m, whose spread is one: a part of each
    block's own and a mean that all have.
    """
    apart = ground[:, None] - ground[None]
    squared = np.einsum("ijk,ijk->ij", apart, apart)
    correlation: Array = np.exp(-0.5 * squared / BLOCK_M**2) + COMMON**2
    return correlation
