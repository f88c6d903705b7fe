"""Decides which estimates are accepted.

An estimate is accepted if the registration succeeded, enough anchors were seen, all evidence
together shows the right position (`localizer.integrity.probability`), and it agrees with the
prediction (Mahalanobis distance). A wider prior contains more similar positions, so it needs more
evidence. A tentative track is rejected if another focal length fits better.
`localizer.tracking.states` derives the tracker's state from accepted and rejected estimates.
"""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from localizer.integrity.probability import log_odds
from localizer.registration.result import Registration
from localizer.types import RegistrationStatus


class IntegrityConfig(BaseModel):
    """Thresholds of the acceptance test, of the state machine and of confirmation."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    min_overlap: float = Field(0.35, ge=0, le=1, description="share of anchors in view")
    # Of 6,301 wrong registrations of ten maps, each by a fit without its kind of map, the highest
    # lie at 2.9 on an outdated map, at 1.7 among equal roofs, and at -1.8 on all others; of 2,895
    # dark ones, at -0.6.
    min_log_odds: float = Field(
        0.7,
        ge=-20,
        le=50,
        description="natural log odds that a registration shows the right place",
    )
    max_focal_gain: float = Field(
        0.01,
        ge=0,
        le=1,
        description="largest gain of another focal length for a tentative registration",
    )
    ambiguity_sigma_m: float = Field(
        3.6,
        ge=0.1,
        le=1e4,
        description="prior sigma above which more evidence is required",
    )
    chi2_threshold: float = Field(
        40.0, ge=1, le=1e4, description="squared Mahalanobis distance, 6 dof"
    )
    confirmations: int = Field(
        3, ge=1, le=1000, description="acceptances in a row that begin TRACKING"
    )
    degraded_after: int = Field(
        3, ge=1, le=1000, description="rejections in a row that end TRACKING"
    )
    lost_after: int = Field(10, ge=1, le=1000, description="rejections in a row until LOST")
    confirm_distance_m: float = Field(
        5.0,
        ge=0.1,
        le=1000,
        description="distance over which a position found without GNSS must hold",
    )
    confirm_still_s: float = Field(
        3.0, ge=0.1, le=60, description="time for a vehicle that does not move"
    )
    confirm_tilt_deg: float = Field(
        6.0, ge=0.1, le=90, description="largest roll and pitch difference to the autopilot"
    )
    confirm_heading_deg: float = Field(
        30.0, ge=0.1, le=180, description="largest heading difference to the autopilot"
    )
    reference_age_s: float = Field(2.0, ge=0.1, le=60, description="oldest usable reference view")


def is_acceptable(
    config: IntegrityConfig,
    result: Registration,
    distance_squared: float,
    prior_sigma_m: float = 0.0,
) -> bool:
    """Whether a registration is accepted. distance_squared: Mahalanobis, from the prediction;
    prior_sigma_m: largest horizontal sigma of the prediction.
    """
    # What is not a number fails a comparison, so each must hold.
    if result.status is not RegistrationStatus.OK or not result.overlap >= config.min_overlap:
        return False
    if not (
        result.focal_gain <= config.max_focal_gain and distance_squared <= config.chi2_threshold
    ):
        return False
    return log_odds(result) >= config.min_log_odds + ambiguity(config, prior_sigma_m)


def ambiguity(config: IntegrityConfig, prior_sigma_m: float) -> float:
    """Natural logarithm of the number of distinct positions within a prior's horizontal sigma."""
    return 2.0 * float(np.log(max(prior_sigma_m / config.ambiguity_sigma_m, 1.0)))
