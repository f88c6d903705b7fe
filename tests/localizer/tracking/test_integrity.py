from dataclasses import replace

import numpy as np
import pytest

from localizer.geometry.pose import Pose
from localizer.registration.result import Registration
from localizer.tracking.integrity import Integrity, IntegrityConfig, is_acceptable, judge
from localizer.types import RegistrationStatus, TrackingState

CONFIG = IntegrityConfig(confirmations=3, degraded_after=2, lost_after=5)


def _run(machine: Integrity, outcomes: str) -> Integrity:
    for outcome in outcomes:
        machine = judge(machine, CONFIG, outcome == "+")
    return machine


def test_tracking_needs_confirmations_in_a_row():
    assert _run(Integrity(), "++").state is TrackingState.INITIALIZING
    assert _run(Integrity(), "++-++").state is TrackingState.INITIALIZING
    assert _run(Integrity(), "+++").state is TrackingState.TRACKING


def test_rejections_degrade_then_lose():
    tracking = _run(Integrity(), "+++")
    assert _run(tracking, "-").state is TrackingState.TRACKING
    assert _run(tracking, "--").state is TrackingState.DEGRADED
    assert _run(tracking, "--+").state is TrackingState.TRACKING
    assert _run(tracking, "-----").state is TrackingState.LOST


def test_lost_recovers_only_by_confirmations():
    lost = _run(Integrity(), "-----")
    assert lost.state is TrackingState.LOST
    assert _run(lost, "+").state is TrackingState.INITIALIZING
    assert _run(lost, "+++").state is TrackingState.TRACKING


def _registration(**change) -> Registration:
    good = Registration(Pose.identity(), np.eye(6), 0.1, 0.9, 0.9, RegistrationStatus.OK, 1)
    return replace(good, **change)


@pytest.mark.parametrize(
    "change",
    [
        {"status": RegistrationStatus.NO_TEXTURE},
        {"overlap": 0.1},
        {"quality": 0.01},
        {"covariance": np.eye(6) * 100.0},
    ],
)
def test_every_criterion_can_reject(change):
    assert is_acceptable(CONFIG, _registration(), 1.0)
    assert not is_acceptable(CONFIG, _registration(**change), 1.0)


def test_the_gate_rejects():
    assert not is_acceptable(CONFIG, _registration(), 1e4)
