"""The tracker's state machine, driven by accepted and rejected registrations.

Rejections lead from TRACKING over DEGRADED to LOST, or to BRIDGING while odometry propagates the
pose; consecutive acceptances lead back. LOST lasts until a position was found and confirmed
(`localizer.integrity.confirmation`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from localizer.geometry.pose import Array, Pose
from localizer.integrity.acceptance import IntegrityConfig
from localizer.integrity.confirmation import (
    Consistency,
    IndependentEvidence,
    TentativeTrack,
    consistency_test,
)
from localizer.tracking.dead_reckoning import PropagationResult
from localizer.types import TrackingState

_SEES = (TrackingState.TRACKING, TrackingState.DEGRADED, TrackingState.BRIDGING)


@dataclass(frozen=True)
class TrackStatus:
    """State of the machine: immutable, `next_status` returns the next one.

    tentative: whether the position was proposed and is not confirmed yet. tentative_track: the
    acceptances since the proposal. independent: of the newest proposal, see `TentativeTrack`.
    last_fix_ns: exposure of the newest fix that was passed on, None before the first.
    """

    state: TrackingState = TrackingState.INITIALIZING
    accepted_in_row: int = 0
    rejected_in_row: int = 0
    tentative: bool = False
    independent: bool = True
    tentative_track: TentativeTrack | None = None
    last_fix_ns: int | None = None

    @property
    def trusts_prediction(self) -> bool:
        """Whether the motion model's prediction may reject a registration."""
        return self.state in _SEES

    @property
    def wants_prior(self) -> bool:
        """Whether an external pose is better than the prediction: while INITIALIZING or LOST,
        unless the newest registration was accepted.
        """
        return self.state not in _SEES and self.accepted_in_row == 0

    def restarted(self) -> TrackStatus:
        """The status after a start from a known pose: as at first, but `last_fix_ns` stays."""
        return TrackStatus(last_fix_ns=self.last_fix_ns)

    def proposed(self, independent: bool) -> TrackStatus:
        """The same status with a new tentative track. independent: see `TentativeTrack`."""
        return replace(
            self, accepted_in_row=0, tentative=True, independent=independent, tentative_track=None
        )


@dataclass(frozen=True)
class RegistrationOutcome:
    """A tested registration. covariance: (6, 6); time_ns: the frame's exposure; carry: the
    odometry's result if the map rejected the frame; beyond_capture: whether the prediction was too
    uncertain for a registration; counts: False if there was neither a reference nor odometry.
    """

    acceptable: bool
    world_from_camera: Pose
    covariance: Array
    time_ns: int
    carry: PropagationResult = PropagationResult.NONE
    beyond_capture: bool = False
    counts: bool = True


_NO_EVIDENCE = IndependentEvidence()


def next_status(
    track_status: TrackStatus,
    config: IntegrityConfig,
    outcome: RegistrationOutcome,
    evidence: IndependentEvidence = _NO_EVIDENCE,
) -> TrackStatus:
    """The next status after one more frame. evidence: of other sensors, for a tentative track."""
    if not outcome.acceptable:
        return _after_rejection(track_status, config, outcome)
    if track_status.tentative:
        return _tentative(track_status, config, outcome, evidence)
    count = track_status.accepted_in_row + 1
    state = track_status.state
    if state is TrackingState.DEGRADED or count >= config.confirmations:
        state = TrackingState.TRACKING
    given = state is not TrackingState.BRIDGING
    return replace(
        track_status,
        state=state,
        accepted_in_row=count,
        rejected_in_row=0,
        last_fix_ns=outcome.time_ns if given else track_status.last_fix_ns,
    )


def _tentative(
    track_status: TrackStatus,
    config: IntegrityConfig,
    outcome: RegistrationOutcome,
    evidence: IndependentEvidence,
) -> TrackStatus:
    tentative_track = track_status.tentative_track or TentativeTrack(
        outcome.world_from_camera, outcome.covariance, outcome.time_ns, track_status.independent
    )
    count = track_status.accepted_in_row + 1
    tried = replace(
        track_status, accepted_in_row=count, rejected_in_row=0, tentative_track=tentative_track
    )
    verdict = consistency_test(
        tentative_track,
        outcome.world_from_camera,
        outcome.covariance,
        outcome.time_ns,
        evidence,
        config,
    )
    if verdict is Consistency.CONTRADICTED:
        refused = replace(outcome, carry=PropagationResult.NONE, beyond_capture=False)
        return _after_rejection(replace(track_status, tentative_track=None), config, refused)
    if verdict is Consistency.PENDING or count < config.confirmations:
        return tried
    return replace(
        tried,
        state=TrackingState.TRACKING,
        tentative=False,
        tentative_track=None,
        last_fix_ns=outcome.time_ns,
    )


def _after_rejection(
    track_status: TrackStatus, config: IntegrityConfig, outcome: RegistrationOutcome
) -> TrackStatus:
    count = track_status.rejected_in_row + int(outcome.counts)
    state = _worse(track_status.state, count, config, outcome)
    trial = track_status.tentative or state is TrackingState.LOST
    return replace(
        track_status,
        state=state,
        accepted_in_row=0,
        rejected_in_row=count,
        tentative=trial,
        independent=track_status.independent and not trial,
        tentative_track=None,
    )


def _worse(
    state: TrackingState, count: int, config: IntegrityConfig, outcome: RegistrationOutcome
) -> TrackingState:
    """The state after `count` rejections in a row. With beyond_capture it worsens at once, because
    at a low frame rate the prediction is useless long before `count` is large.
    """
    carry = outcome.carry
    if state is TrackingState.BRIDGING:
        holds = carry in (PropagationResult.CARRIED, PropagationResult.GAP)
        return TrackingState.BRIDGING if holds else TrackingState.LOST
    is_due = count >= config.degraded_after or outcome.beyond_capture
    if state in _SEES and is_due and carry is PropagationResult.CARRIED:
        return TrackingState.BRIDGING
    beyond = state in _SEES and outcome.beyond_capture
    if beyond or count >= config.lost_after:
        return TrackingState.LOST
    if state is TrackingState.TRACKING and count >= config.degraded_after:
        return TrackingState.DEGRADED
    return state
