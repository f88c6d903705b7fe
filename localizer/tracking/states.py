"""The tracker's state: what runs of acceptances and rejections make of it.

Rejections lead from TRACKING over DEGRADED to LOST, or to BRIDGING as long as the odometry carries
the pose on; from there acceptances in a row lead back. LOST lasts until a place was found again
and confirmed (`localizer.integrity.confirmation`): a new guess is tried, it does not end it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from localizer.geometry.pose import Array, Pose
from localizer.integrity.acceptance import IntegrityConfig
from localizer.integrity.confirmation import Probation, Verdict, Witness, weigh
from localizer.tracking.bridging import Carry
from localizer.types import TrackingState

_SEES = (TrackingState.TRACKING, TrackingState.DEGRADED, TrackingState.BRIDGING)


@dataclass(frozen=True)
class Standing:
    """State of the machine: immutable, `judge` returns the next one.

    on_trial: the place was proposed, and counts only once it is confirmed. probation: the run of
    acceptances there. independent: of the newest proposal, see `Probation`. last_fix_ns: exposure
    of the newest fix that was given out, None before the first.
    """

    state: TrackingState = TrackingState.INITIALIZING
    accepted_in_row: int = 0
    rejected_in_row: int = 0
    on_trial: bool = False
    independent: bool = True
    probation: Probation | None = None
    last_fix_ns: int | None = None

    @property
    def trusts_prediction(self) -> bool:
        """Whether the prediction may reject an estimate."""
        return self.state in _SEES

    @property
    def wants_prior(self) -> bool:
        """Whether a pose known outside is better than the prediction: before the first acceptance,
        and when LOST, as long as nothing is on probation.
        """
        return self.state not in _SEES and self.accepted_in_row == 0

    def begun(self) -> Standing:
        """Begun anew from a pose that is known."""
        return Standing(last_fix_ns=self.last_fix_ns)

    def proposed(self, independent: bool) -> Standing:
        """The same state, with a new place on trial. independent: see `Probation`."""
        return replace(
            self, accepted_in_row=0, on_trial=True, independent=independent, probation=None
        )


@dataclass(frozen=True)
class Outcome:
    """A registration that was judged. covariance: (6, 6); time_ns: the frame's exposure; carry:
    what the odometry made of a frame that the map rejected.
    """

    acceptable: bool
    world_from_camera: Pose
    covariance: Array
    time_ns: int
    carry: Carry = Carry.NONE


_NO_WITNESS = Witness()


def judge(
    standing: Standing, config: IntegrityConfig, outcome: Outcome, witness: Witness = _NO_WITNESS
) -> Standing:
    """The machine after one more frame; witness: what other sensors say, for a place on trial."""
    if not outcome.acceptable:
        return _after_rejection(standing, config, outcome.carry)
    if standing.on_trial:
        return _on_trial(standing, config, outcome, witness)
    count = standing.accepted_in_row + 1
    state = standing.state
    if state is TrackingState.DEGRADED or count >= config.confirmations:
        state = TrackingState.TRACKING
    given = state is not TrackingState.BRIDGING
    return replace(
        standing,
        state=state,
        accepted_in_row=count,
        rejected_in_row=0,
        last_fix_ns=outcome.time_ns if given else standing.last_fix_ns,
    )


def _on_trial(
    standing: Standing, config: IntegrityConfig, outcome: Outcome, witness: Witness
) -> Standing:
    probation = standing.probation or Probation(
        outcome.world_from_camera, outcome.covariance, outcome.time_ns, standing.independent
    )
    count = standing.accepted_in_row + 1
    tried = replace(standing, accepted_in_row=count, rejected_in_row=0, probation=probation)
    verdict = weigh(
        probation, outcome.world_from_camera, outcome.covariance, outcome.time_ns, witness, config
    )
    if verdict is Verdict.CONTRADICTED:
        return _after_rejection(replace(standing, probation=None), config, Carry.NONE)
    if verdict is Verdict.PENDING or count < config.confirmations:
        return tried
    return replace(
        tried,
        state=TrackingState.TRACKING,
        on_trial=False,
        probation=None,
        last_fix_ns=outcome.time_ns,
    )


def _after_rejection(standing: Standing, config: IntegrityConfig, carry: Carry) -> Standing:
    count = standing.rejected_in_row + 1
    state = _worse(standing.state, count, config, carry)
    trial = standing.on_trial or state is TrackingState.LOST
    return replace(
        standing,
        state=state,
        accepted_in_row=0,
        rejected_in_row=count,
        on_trial=trial,
        independent=standing.independent and not trial,
        probation=None,
    )


def _worse(
    state: TrackingState, count: int, config: IntegrityConfig, carry: Carry
) -> TrackingState:
    """The state after `count` rejections in a row."""
    if state is TrackingState.BRIDGING:
        holds = carry in (Carry.CARRIED, Carry.GAP)
        return TrackingState.BRIDGING if holds else TrackingState.LOST
    if state in _SEES and count >= config.degraded_after and carry is Carry.CARRIED:
        return TrackingState.BRIDGING
    if count >= config.lost_after:
        return TrackingState.LOST
    if state is TrackingState.TRACKING and count >= config.degraded_after:
        return TrackingState.DEGRADED
    return state
