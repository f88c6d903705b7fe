"""The result of a registration, computed from the found poses."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array, Pose
from localizer.registration.agreement import PatchAgreement
from localizer.registration.backend import world_from_camera
from localizer.registration.config import JNGOConfig
from localizer.registration.covariance import (
    CovarianceSums,
    image_gap_px,
    mode_spread,
    pose_covariance,
    pose_differences,
    sandwich_covariance,
)
from localizer.registration.selection import LEAST_SCORE, mode_probabilities
from localizer.types import PosePrior, RegistrationStatus


@dataclass(frozen=True)
class Registration:
    """A registered pose; after a failure the prior's, with the reason in `status`.

    covariance: (6, 6) as `PosePrior`'s. score: mean Huber cost, lower is better, inf on failure.
    overlap: share of the anchors in view. quality: 0 (no better than chance) to 1. evaluations:
    number of cost evaluations. agreement: of the image's patches; None if unknown (features on a
    GPU, or a failure). lead: relative difference of the score of the best other mode, inf without
    another. focal_gain: relative improvement with another focal length (`zoom.FocalTest`), -inf if
    not tested. mode_covariance: (6, 6), part of the covariance that stems from other modes
    (equation 14). noise: (6, 6), the part that is independent in each frame, for a filter over
    frames; None: the whole covariance. earlier_log_odds: smallest log odds of the image's earlier
    passes (`localizer.integrity.probability`), inf without any.
    """

    world_from_camera: Pose
    covariance: Array
    score: float
    overlap: float
    quality: float
    status: RegistrationStatus
    evaluations: int
    agreement: PatchAgreement | None = None
    lead: float = np.inf
    focal_gain: float = -np.inf
    mode_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    noise: Array | None = None
    earlier_log_odds: float = np.inf


@dataclass(frozen=True)
class SearchSurvivors:
    """Result of a search. rotations (K, 3, 3), translations (K, 3): the survivors,
    camera_from_local, best first, the first one refined further; scores and overlaps (K,): at the
    end of the search; sums: of equation 11 at the first one, None if no anchor has weight;
    prior_weight: of a constraint, 0 without; agreement: as `Registration`'s.
    """

    rotations: Array
    translations: Array
    scores: Array
    overlaps: Array
    sums: CovarianceSums | None
    prior_weight: float
    quality: float
    evaluations: int
    agreement: PatchAgreement | None = None


def registration(
    found: SearchSurvivors, config: JNGOConfig, prior: PosePrior, origin: Array
) -> Registration:
    """The chosen pose with its covariance (equations 11 to 14), or NO_TEXTURE. origin: (3,) of the
    local frame, world.
    """
    tangent = None
    if found.sums is not None:
        tangent = sandwich_covariance(found.sums, config.noise, found.prior_weight)
    if found.sums is None or tangent is None:
        return failure(prior, RegistrationStatus.NO_TEXTURE, found.evaluations)
    rotations, centres = world_from_camera(found.rotations, found.translations, origin)
    pose = Pose(rotations[0], centres[0])
    differences = pose_differences(rotations, centres, pose)
    R, t = found.rotations[0], found.translations[0]
    other = image_gap_px(differences, R, t, found.sums.motion) > config.mode_px
    probabilities = mode_probabilities(found.scores, found.sums.cells, other)
    spread = mode_spread(differences, probabilities)
    covariance = pose_covariance(tangent, R, t) + spread
    if np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) > config.max_sigma_m:
        return failure(prior, RegistrationStatus.NO_TEXTURE, found.evaluations)
    return Registration(
        pose,
        covariance,
        float(found.scores[0]),
        float(found.overlaps[0]),
        found.quality,
        RegistrationStatus.OK,
        found.evaluations,
        found.agreement,
        _lead(found.scores, other),
        mode_covariance=spread,
    )


def _lead(scores: Array, other: NDArray[np.bool_]) -> float:
    """Difference of the best score of the `other` modes (M,) from the first, divided by it."""
    rivals = scores[other & np.isfinite(scores)]
    if len(rivals) == 0:
        return np.inf
    return float((rivals.min() - scores[0]) / max(scores[0], LEAST_SCORE))


def failure(prior: PosePrior, status: RegistrationStatus, evaluations: int = 0) -> Registration:
    """A failed registration: the prior's pose and the reason."""
    return Registration(
        prior.world_from_camera, prior.covariance, np.inf, 0.0, 0.0, status, evaluations
    )
