"""Estimates the error of the map's heights from the registered images.

A terrain or flat map lacks buildings and trees. Their parallax biases a registered pose by a tilt,
a shift and a lower camera. The size of the missing heights shows in the displacements of the image
patches, and in the difference of registered tilt and height from gravity and barometer. Each
registration over new ground gives the likelihood of a few candidate values; their product over a
flight is the posterior.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from localizer.geometry.pose import Array, Pose
from localizer.integrity.patch_covariance import COMMON, LEAST_PATCHES, height_correlation
from localizer.map.kind import MapKind
from localizer.registration.agreement import PatchDisplacements
from localizer.registration.priors import PoseConstraint, constraint_rows

CANDIDATES_M = np.array([0.0, 0.3, 0.6, 1.2, 2.5, 5.0, 10.0])
"""Spreads of the missing heights that are tried, m."""
_NOISE_PX = np.array([0.1, 0.2, 0.4, 0.8, 1.2, 1.8, 2.6])  # of a patch, profiled
_TEMPERED = 0.5  # of the log likelihood: patches are not wholly independent
_KEPT = 0.9  # of what older ground said, at each new one: a village follows on fields
_SURE_M = 0.065  # of a surface model: its prior falls by e at each


def height_likelihood(
    patches: PatchDisplacements, pose: Pose, constraint: PoseConstraint | None
) -> Array | None:
    """Log likelihood (K,) of each of `CANDIDATES_M` for one registered image, up to a constant.

    The pose is marginalised (restricted maximum likelihood), and the patches' noise is profiled.
    pose: at which the patches were measured; constraint: what other sensors measured of it. None if
    there are too few patches.
    """
    if len(patches.shift) < LEAST_PATCHES:
        return None
    values, y, rows = _decorrelated(patches)
    known, wanted = np.zeros((0, 6)), np.zeros(0)
    if constraint is not None:
        known, wanted = constraint_rows(constraint, pose)
    unit = 1.0 / np.sqrt(np.maximum((rows**2).sum(axis=0), 1e-300))
    rows, known = rows * unit, known * unit
    raised = CANDIDATES_M[:, None, None] ** 2 * np.maximum(values, 0.0)
    variance = _NOISE_PX[:, None] ** 2 + raised
    result = _marginal(y, rows, known, wanted, 1.0 / variance).max(axis=1)
    relative: Array = result - result.max()
    return relative


def _decorrelated(patches: PatchDisplacements) -> tuple[Array, Array, Array]:
    """Uncorrelated combinations of the displacements (2 P,), their motion (2 P, 6), and the
    variances (2 P,) that heights of unit sigma cause in them.

    A height moves its patch along one line, so only the components along these lines are
    correlated.
    """
    length = np.hypot(patches.rise[:, 0], patches.rise[:, 1])
    along = np.where(length[:, None] > 0, patches.rise, (1.0, 0.0))
    along = along / np.hypot(along[:, :1], along[:, 1:])
    across = along[:, ::-1] * (-1.0, 1.0)
    both = np.concatenate([patches.shift[..., None], patches.motion], axis=2)
    values, basis = np.linalg.eigh(height_correlation(patches.ground) * np.outer(length, length))
    moved = [np.einsum("pa,pai->pi", axis, both) for axis in (along, across)]
    turned = np.concatenate([basis.T @ moved[0], moved[1]])
    return np.concatenate([values, np.zeros(len(values))]), turned[:, 0], turned[:, 1:]


def _marginal(y: Array, rows: Array, known: Array, wanted: Array, weight: Array) -> Array:
    """Log likelihood (...) of ``y = rows d + noise`` and ``wanted = known d + noise``, over all d.

    weight: (..., n) of y; -inf where the rows do not determine d.
    """
    normal = rows.T @ (weight[..., None] * rows) + known.T @ known
    right = (weight * y) @ rows + known.T @ wanted
    sign, logdet = np.linalg.slogdet(normal)
    sound = np.where((sign > 0)[..., None, None], normal, np.eye(6))
    explained = (right * np.linalg.solve(sound, right[..., None])[..., 0]).sum(axis=-1)
    left = weight @ y**2 + wanted @ wanted - explained
    likelihood = 0.5 * np.log(weight).sum(axis=-1) - 0.5 * logdet - 0.5 * left
    return np.where(sign > 0, likelihood, -np.inf)


def _mean_square(log_posterior: Array) -> float:
    weight = np.exp(log_posterior - log_posterior.max())
    return float((weight * CANDIDATES_M**2).sum() / weight.sum())


@dataclass(frozen=True)
class MapHeightError:
    """Posterior of the RMS height that the map lacks. log_prior: (K,) by the map's kind; evidence:
    (K,) log likelihood of the images so far, with less weight for older ground; calibrated_m2: mean
    square that `CalibrationSigmas.map_m` contains.
    """

    log_prior: Array = field(default_factory=lambda: np.zeros(len(CANDIDATES_M)))
    evidence: Array = field(default_factory=lambda: np.zeros(len(CANDIDATES_M)))
    calibrated_m2: float = 0.0

    @classmethod
    def prior(cls, expected_m: float | None) -> MapHeightError:
        """The posterior before the first image. expected_m: by the map's kind; None if unknown."""
        if expected_m is None:
            return cls()
        if expected_m <= _SURE_M:
            log_prior = -CANDIDATES_M / _SURE_M
            return cls(log_prior, calibrated_m2=_mean_square(log_prior))
        off = np.log2(np.maximum(CANDIDATES_M, 0.15) / expected_m)
        return cls(-0.5 * off**2)

    @classmethod
    def of_kind(cls, kind: MapKind | None) -> MapHeightError:
        """The posterior before the first image over a map of this kind; None: unknown."""
        if kind is None:
            return cls()
        if kind.has_buildings:
            return cls.prior(0.0)
        return cls.prior(kind.unknown_height_sigma_m / np.hypot(1.0, COMMON))

    @property
    def sigma_m(self) -> float:
        """RMS missing height over the posterior, m; of a surface model what exceeds its prior."""
        missing_m2 = _mean_square(self.log_prior + self.evidence) - self.calibrated_m2
        return float(np.sqrt(max(missing_m2, 0.0)))

    def updated(self, likelihood: Array) -> MapHeightError:
        """The posterior after another image of new ground, by its `height_likelihood` (K,)."""
        return replace(self, evidence=_KEPT * self.evidence + _TEMPERED * likelihood)
