"""Which estimates may be used, and what the tracker's state is.

An estimate is accepted when the registration succeeded, enough anchors were seen, its quality is
high enough and it agrees with the prediction (Mahalanobis gate). Runs of rejections lead from
TRACKING over DEGRADED to LOST; consecutive acceptances lead back. A registration that is good in
itself but contradicts the prediction is rejected, and widens the prediction (`motion.inflated`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from pydantic import BaseModel, ConfigDict, Field

from localizer.registration.result import Registration
from localizer.types import RegistrationStatus, TrackingState


class IntegrityConfig(BaseModel):
    """Thresholds of the acceptance test and of the state machine."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    min_overlap: float = Field(0.35, ge=0, le=1, description="share of anchors in view")
    min_quality: float = Field(0.15, ge=0, le=1, description="registration quality")
    max_sigma_m: float = Field(
        4.0, ge=0.01, le=100, description="position sigma of a usable estimate"
    )
    gate: float = Field(40.0, ge=1, le=1e4, description="squared Mahalanobis distance, 6 dof")
    confirmations: int = Field(
        3, ge=1, le=1000, description="acceptances in a row that begin TRACKING"
    )
    degraded_after: int = Field(
        3, ge=1, le=1000, description="rejections in a row that end TRACKING"
    )
    lost_after: int = Field(10, ge=1, le=1000, description="rejections in a row until LOST")


@dataclass(frozen=True)
class Integrity:
    """State of the machine: immutable, `judge` returns the next one."""

    state: TrackingState = TrackingState.INITIALIZING
    accepted_in_row: int = 0
    rejected_in_row: int = 0

    @property
    def trusts_prediction(self) -> bool:
        """Whether the prediction may reject an estimate."""
        return self.state in (TrackingState.TRACKING, TrackingState.DEGRADED)

    @property
    def wants_prior(self) -> bool:
        """Whether a pose known outside is better than the prediction: before the first acceptance,
        and when LOST.
        """
        untouched = self.accepted_in_row == 0 and self.state is TrackingState.INITIALIZING
        return untouched or self.state is TrackingState.LOST


def is_acceptable(config: IntegrityConfig, result: Registration, distance_squared: float) -> bool:
    """Whether one registration may be used; distance_squared: Mahalanobis, from the prediction."""
    if result.status is not RegistrationStatus.OK:
        return False
    if result.overlap < config.min_overlap or result.quality < config.min_quality:
        return False
    if result.covariance.diagonal()[:3].max() > config.max_sigma_m**2:
        return False
    return distance_squared <= config.gate


def judge(integrity: Integrity, config: IntegrityConfig, acceptable: bool) -> Integrity:
    """The machine after one more frame."""
    if acceptable:
        return _after_acceptance(integrity, config)
    return _after_rejection(integrity, config)


def _after_acceptance(integrity: Integrity, config: IntegrityConfig) -> Integrity:
    count = integrity.accepted_in_row + 1
    state = integrity.state
    if state is TrackingState.DEGRADED or count >= config.confirmations:
        state = TrackingState.TRACKING
    elif state is TrackingState.LOST:
        state = TrackingState.INITIALIZING
    return Integrity(state, count, 0)


def _after_rejection(integrity: Integrity, config: IntegrityConfig) -> Integrity:
    count = integrity.rejected_in_row + 1
    state = integrity.state
    if count >= config.lost_after:
        state = TrackingState.LOST
    elif state is TrackingState.TRACKING and count >= config.degraded_after:
        state = TrackingState.DEGRADED
    return replace(integrity, state=state, accepted_in_row=0, rejected_in_row=count)
