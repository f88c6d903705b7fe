from localizer.integrity import Integrity, IntegrityConfig, is_acceptable, judge
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


def test_every_criterion_can_reject():
    good = {"status": RegistrationStatus.OK, "overlap": 0.9, "quality": 0.9, "distance_squared": 1}
    bad = [
        {"status": RegistrationStatus.NO_TEXTURE},
        {"overlap": 0.1},
        {"quality": 0.01},
        {"distance_squared": 1e4},
    ]
    assert is_acceptable(CONFIG, **good)
    for change in bad:
        assert not is_acceptable(CONFIG, **(good | change)), change
