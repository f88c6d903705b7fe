"""Which estimates may be used.

An estimate is acceptable when the registration succeeded, enough anchors were seen, its quality is
high enough, the image's parts agree on it one by one, and it agrees with the prediction
(Mahalanobis gate). Where the prediction is wide, the place has to stand out among those beside it;
where a place is on trial, no other focal length may fit better. What runs of acceptances and
rejections make of the tracker's state stands in `localizer.tracking.states`.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from localizer.registration.result import Registration
from localizer.types import RegistrationStatus


class IntegrityConfig(BaseModel):
    """Thresholds of the acceptance test, of the state machine and of confirmation."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    min_overlap: float = Field(0.35, ge=0, le=1, description="share of anchors in view")
    min_quality: float = Field(0.15, ge=0, le=1, description="registration quality")
    min_patch_inlier_ratio: float = Field(
        0.4, ge=0, le=1, description="share of the image patches that agree on the pose"
    )
    min_patches: int = Field(8, ge=0, le=1000, description="patches (32 px) needed for that")
    max_sigma_m: float = Field(
        4.0, ge=0.01, le=100, description="position sigma of a usable estimate"
    )
    max_focal_gain: float = Field(
        0.01,
        ge=0,
        le=1,
        description="largest gain of another focal length for a tentative registration",
    )
    ambiguity_sigma_m: float = Field(
        6.0,
        ge=0,
        le=1e4,
        description="prior sigma above which the peak must stand out",
    )
    peak_to_sidelobe_min: float = Field(
        4.5,
        ge=0,
        le=100,
        description="peak-to-sidelobe ratio, in sigmas, that stands out",
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
    """Whether one registration may be used. distance_squared: Mahalanobis, from the prediction;
    prior_sigma_m: of the prediction's horizontal place, the larger axis.
    """
    if result.status is not RegistrationStatus.OK:
        return False
    if result.overlap < config.min_overlap or result.quality < config.min_quality:
        return False
    if result.covariance.diagonal()[:3].max() > config.max_sigma_m**2:
        return False
    if not parts_agree(config, result) or result.focal_gain > config.max_focal_gain:
        return False
    if prior_sigma_m >= config.ambiguity_sigma_m and not stands_out(config, result):
        return False
    return distance_squared <= config.chi2_threshold


def stands_out(config: IntegrityConfig, result: Registration) -> bool:
    """Whether the image matches its place clearly better than what lies beside it.

    Equal roofs in rows match each other as well as themselves. A prior that is narrower than a
    lot says which of them is seen; a wider one does not, and no test of one picture can. On a GPU
    there are no votes: what is searched there is judged by the relocalizer's verdict alone.
    """
    return result.agreement is None or result.agreement.peak >= config.peak_to_sidelobe_min


def parts_agree(config: IntegrityConfig, result: Registration) -> bool:
    """Whether enough parts of the image vote for the pose; a registration on a GPU has no votes and
    passes.
    """
    votes = result.agreement
    if votes is None:
        return True
    return votes.patches >= config.min_patches and votes.share >= config.min_patch_inlier_ratio
