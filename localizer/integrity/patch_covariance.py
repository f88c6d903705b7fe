"""Covariance of a registered pose from the displacements of image patches (registration.md, 8a).

At the registered pose each patch has a shift at which it matches the map best. With a perfect map
these shifts would be noise of a fraction of a pixel. If the map is of another date or sensor they
scatter more, and if it lacks buildings and trees, parallax displaces every roof. Patches on one
roof have the same error, so treating anchors as independent would make the sigma ten times too
small. The pose follows the displacements by least squares, ``xi = (X'X)^-1 X'd``, with covariance
``(X'X)^-1 X' W X (X'X)^-1``. W is the sum of independent noise per patch, measured from the
displacements, and of the missing heights. Patches that show nothing of the map, as in the dark,
pull the pose at random and do not hold it: where a share f holds it, the noise displaces it 1 / f
times as far. The residuals of the anchors give a covariance as well. It knows which patches hold
the pose, so noise of the patches counts only where it exceeds what this covariance explains.
"""

from __future__ import annotations

import numpy as np

from localizer.geometry.pose import Array, scaled_inverse
from localizer.registration.agreement import PatchDisplacements

LEAST_PATCHES = 8  # six numbers are fitted
# Of the covariance by residuals, which is right over changed maps: over caliterra, portugal and
# quito its mean NEES is about 0.5 per axis. Without any one of these sets, the others give this
# value, too: the least tenth with 93 % of their errors inside the 95 % bound.
_RESIDUALS_SHARE = 0.5
_LEAST_PX = 0.05  # of the scatter: a perfect fit is no perfect knowledge
# Both were chosen on fengyuan, with a look at NEON and caliterra; no other town has checked them.
BLOCK_M = 20.0  # over which an unknown height is the same: a building, a row of trees
COMMON = 2.0  # mean of the unknown heights over their spread: buildings stand on the ground


def patch_covariance(
    patches: PatchDisplacements, height_sigma_m: float, by_residuals: Array
) -> Array | None:
    """Covariance (6, 6), as `PosePrior`'s, of the pose at which the patches were measured.

    height_sigma_m: RMS of the heights that the map lacks; 0 for a surface model. by_residuals:
    (6, 6), as `localizer.registration.covariance` has it. None if the patches do not determine a
    pose.
    """
    if len(patches.shift) < LEAST_PATCHES or patches.matched <= 0.0:
        return None
    rows = patches.motion.reshape(-1, 6)
    normal = rows.T @ rows
    if (inverse := scaled_inverse(normal)) is None:
        return None
    noise_px = max(patches.scatter_px, _LEAST_PX) / patches.matched
    # Along each axis of the image's motion the larger of the two variances.
    root = np.linalg.cholesky(normal)
    known, axes = np.linalg.eigh(root.T @ (_RESIDUALS_SHARE * by_residuals) @ root)
    spread = np.linalg.solve(root.T, axes)
    covariance = spread @ np.diag(np.maximum(known, noise_px**2)) @ spread.T
    if height_sigma_m > 0:
        pull = np.einsum("kai,ka->ki", patches.motion, patches.rise)
        meat = height_sigma_m**2 * pull.T @ height_correlation(patches.ground) @ pull
        covariance = covariance + inverse @ meat @ inverse
    symmetric: Array = 0.5 * (covariance + covariance.T)
    return symmetric


def height_correlation(ground: Array) -> Array:
    """(P, P) covariance, of unit variance, of unknown heights at positions (P, 2), m: one part is
    common to a block, one to all.
    """
    apart = ground[:, None] - ground[None]
    squared = np.einsum("ijk,ijk->ij", apart, apart)
    correlation: Array = np.exp(-0.5 * squared / BLOCK_M**2) + COMMON**2
    return correlation
