"""The tracker's state over runs of acceptances and rejections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.integrity.acceptance import IntegrityConfig
from localizer.integrity.confirmation import IndependentEvidence
from localizer.tracking.dead_reckoning import PropagationResult
from localizer.tracking.states import RegistrationOutcome, TrackStatus, next_status
from localizer.types import TrackingState

CONFIG = IntegrityConfig(confirmations=3, degraded_after=2, lost_after=5)
SECOND = 10**9


def outcome(
    acceptable: bool, frame: int, east_m: float = 0.0, turn: Array | None = None
) -> RegistrationOutcome:
    rotation = np.eye(3) if turn is None else so3_exp(turn)
    pose = Pose(rotation, np.array([east_m, 0.0, 100.0]))
    return RegistrationOutcome(acceptable, pose, np.eye(6) * 0.01, frame * SECOND // 10)


def run(
    machine: TrackStatus,
    outcomes: str,
    speed_m: float = 0.0,
    evidence: IndependentEvidence = IndependentEvidence(),  # noqa: B008
    first: int = 0,
) -> TrackStatus:
    """The machine after frames, 0.1 s and `speed_m` metres apart."""
    for n, mark in enumerate(outcomes, first):
        machine = next_status(machine, CONFIG, outcome(mark == "+", n, n * speed_m), evidence)
    return machine


def test_tracking_needs_confirmations_in_a_row() -> None:
    assert run(TrackStatus(), "++").state is TrackingState.INITIALIZING
    assert run(TrackStatus(), "++-++").state is TrackingState.INITIALIZING
    assert run(TrackStatus(), "+++").state is TrackingState.TRACKING


def test_rejections_degrade_then_lose() -> None:
    tracking = run(TrackStatus(), "+++")
    assert run(tracking, "-").state is TrackingState.TRACKING
    assert run(tracking, "--").state is TrackingState.DEGRADED
    assert run(tracking, "--+").state is TrackingState.TRACKING
    assert run(tracking, "-----").state is TrackingState.LOST


def test_a_prediction_beyond_capture_is_lost_at_once_unless_the_odometry_carries() -> None:
    """One frame a second: ten rejections were ten seconds."""
    tracking = run(TrackStatus(), "+++")
    far = replace(outcome(False, 3), beyond_capture=True)
    assert next_status(tracking, CONFIG, far).state is TrackingState.LOST
    carried = replace(far, carry=PropagationResult.CARRIED)
    assert next_status(tracking, CONFIG, carried).state is TrackingState.BRIDGING
    assert next_status(TrackStatus(), CONFIG, far).state is TrackingState.INITIALIZING


def test_frames_without_a_reference_end_tracking_by_their_prediction_alone() -> None:
    machine = run(TrackStatus(), "+++")
    blind = replace(outcome(False, 3), counts=False)
    for _ in range(2 * CONFIG.lost_after):
        machine = next_status(machine, CONFIG, blind)
    assert machine.state is TrackingState.TRACKING
    machine = next_status(machine, CONFIG, replace(blind, beyond_capture=True))
    assert machine.state is TrackingState.LOST


def test_lost_lasts_however_often_it_is_tried_again() -> None:
    """280 bad frames after 20 good ones were "initializing" for 270, lost for one."""
    machine = run(TrackStatus(), "+" * 20)
    states = []
    for n in range(280):
        machine = next_status(machine, CONFIG, outcome(False, 20 + n))
        if machine.wants_prior:
            machine = machine.proposed(independent=False)
        states.append(machine.state)
    assert states.count(TrackingState.LOST) == 280 - 4
    assert machine.last_fix_ns == 19 * SECOND // 10


def test_three_frames_of_the_same_view_confirm_nothing() -> None:
    lost = run(TrackStatus(), "-----").proposed(independent=False)
    assert run(lost, "+++").state is TrackingState.LOST
    assert run(lost, "+" * 200).state is TrackingState.LOST


def test_the_way_flown_on_confirms() -> None:
    lost = run(TrackStatus(), "-----").proposed(independent=False)
    assert run(lost, "+++++", speed_m=1.0).state is TrackingState.LOST
    assert run(lost, "++++++", speed_m=1.0).state is TrackingState.TRACKING


def test_a_hover_is_confirmed_by_the_attitude_that_the_autopilot_knows() -> None:
    lost = run(TrackStatus(), "-----").proposed(independent=False)
    upright = IndependentEvidence(rotation=np.eye(3))
    assert run(lost, "+" * 29, evidence=upright).state is TrackingState.LOST
    assert run(lost, "+" * 31, evidence=upright).state is TrackingState.TRACKING


@pytest.mark.parametrize("turn", [np.radians([9.0, 0, 0]), np.radians([0, 0, 40.0])])
def test_a_place_with_another_attitude_is_refuted(turn: Array) -> None:
    lost = run(TrackStatus(), "-----").proposed(independent=False)
    refuted = run(lost, "+" * 40, speed_m=1.0, evidence=IndependentEvidence(rotation=so3_exp(turn)))
    assert refuted.state is TrackingState.LOST
    assert refuted.accepted_in_row == 0


def test_a_place_that_moves_otherwise_than_the_vehicle_is_refuted() -> None:
    lost = run(TrackStatus(), "-----").proposed(independent=False)
    still = IndependentEvidence(rotation=np.eye(3), displacement=(np.zeros(3), 0.2))
    assert run(lost, "+" * 6, speed_m=1.0, evidence=still).state is TrackingState.LOST
    for n in range(6):
        way = IndependentEvidence(np.eye(3), (np.array([n + 0.5, 0, 0]), 0.2))
        lost = next_status(lost, CONFIG, outcome(True, n, float(n)), way)
    assert lost.state is TrackingState.TRACKING


def test_agreement_with_healthy_gnss_is_evidence_enough() -> None:
    lost = run(TrackStatus(), "-----").proposed(independent=True)
    assert run(lost, "+++").state is TrackingState.TRACKING


def test_a_cold_start_without_gnss_is_on_trial_too() -> None:
    machine = TrackStatus().proposed(independent=False)
    assert run(machine, "+" * 10).state is TrackingState.INITIALIZING
    assert run(machine, "+" * 10, speed_m=1.0).state is TrackingState.TRACKING


def test_one_rejection_ends_a_probation() -> None:
    lost = run(TrackStatus(), "-----").proposed(independent=False)
    machine = run(lost, "++++-++", speed_m=1.0)
    assert machine.state is TrackingState.LOST
    assert machine.accepted_in_row == 2


def carried(carry: PropagationResult, frame: int) -> RegistrationOutcome:
    return replace(outcome(False, frame), carry=carry)


def test_rejections_that_the_odometry_carries_are_bridged_and_not_lost() -> None:
    machine = run(TrackStatus(), "+++")
    for n in range(3, 60):
        machine = next_status(machine, CONFIG, carried(PropagationResult.CARRIED, n))
    assert machine.state is TrackingState.BRIDGING
    assert machine.last_fix_ns == 2 * SECOND // 10  # of the map, not of the odometry
    assert run(machine, "++", first=60).state is TrackingState.BRIDGING
    assert run(machine, "+++", first=60).state is TrackingState.TRACKING


def test_a_frame_that_shows_nothing_is_a_gap_and_a_broken_thread_is_lost() -> None:
    machine = run(TrackStatus(), "+++")
    for n in range(3, 9):
        machine = next_status(machine, CONFIG, carried(PropagationResult.CARRIED, n))
    machine = next_status(machine, CONFIG, carried(PropagationResult.GAP, 9))
    assert machine.state is TrackingState.BRIDGING
    machine = next_status(machine, CONFIG, carried(PropagationResult.BROKEN, 10))
    assert machine.state is TrackingState.LOST
    assert machine.wants_prior


def test_a_place_on_trial_is_not_bridged() -> None:
    lost = run(TrackStatus(), "-----").proposed(independent=False)
    assert (
        next_status(lost, CONFIG, carried(PropagationResult.CARRIED, 9)).state is TrackingState.LOST
    )
