"""Which estimates become fixes, which of them carries a jump, and who may withhold one."""

from dataclasses import replace

import numpy as np
import pytest

from companion.conversions import CameraExtrinsics
from companion.flight.injection import FixInjection
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.types import TrackingState
from mavlink_bridge.alerts.catalogue import alert, cleared
from mavlink_bridge.alerts.ids import AlertId
from tests.companion.estimates import estimated

LOST, TRACKING = TrackingState.LOST, TrackingState.TRACKING
DEGRADED, INITIALIZING = TrackingState.DEGRADED, TrackingState.INITIALIZING
BRIDGING = TrackingState.BRIDGING
INSTALLATION = CameraExtrinsics(LocalFrame(Geodetic(47.3, 8.5, 450.0)), 47.5, np.zeros(3))


class FakeBridge:
    def __init__(self):
        self.fixes = []
        self.said = []

    def report_alert(self, alert):
        self.said.append(alert)

    def attitude_at(self, _):
        return None

    def gimbal_at(self, _):
        return None

    def submit(self, fix):
        self.fixes.append(fix)


def _estimate(state, accepted=True):
    scale_sigma = 0.2 if state is BRIDGING else None
    return estimated(state=state, accepted=accepted, scale_sigma=scale_sigma)


@pytest.mark.parametrize(
    ("states", "counts"),
    [
        ((INITIALIZING, TRACKING, TRACKING), [1, 1]),
        ((TRACKING, DEGRADED, TRACKING), [1, 1]),  # it kept the filter's track
        ((TRACKING, LOST, LOST, INITIALIZING, TRACKING, TRACKING), [1, 2, 2]),
        # What odometry drifted by ends where the map is found again.
        ((TRACKING, BRIDGING, BRIDGING, TRACKING, TRACKING), [1, 1, 1, 2, 2]),
    ],
)
def test_only_a_new_start_is_a_jump(states, counts):
    bridge = FakeBridge()
    injection = FixInjection(bridge, INSTALLATION)
    for state in states:
        injection.add_estimate(_estimate(state), None)
    assert [fix.reset_count for fix in bridge.fixes] == counts
    sent = [state for state in states if state in (TRACKING, BRIDGING)]
    assert [fix.by_odometry for fix in bridge.fixes] == [state is BRIDGING for state in sent]


def test_what_is_rejected_or_unconfirmed_is_not_injected():
    bridge = FakeBridge()
    injection = FixInjection(bridge, INSTALLATION)
    injection.add_estimate(_estimate(TRACKING, accepted=False), None)
    for state in (INITIALIZING, DEGRADED, LOST):
        injection.add_estimate(_estimate(state), None)
    assert bridge.fixes == []


def test_a_judge_withholds_or_widens_and_observers_see_each_fix_as_it_was_made():
    bridge, seen, verdicts = FakeBridge(), [], iter([None, "wider", "as it is"])
    injection = FixInjection(bridge, INSTALLATION)

    def judge(estimate, fix):
        verdict = next(verdicts)
        if verdict == "wider":
            return replace(fix, position_covariance_ned=4.0 * fix.position_covariance_ned)
        return fix if verdict else None

    injection.add_check(judge)
    injection.add_observer(lambda _estimate, _bundle, fix: seen.append(fix))
    for _ in range(3):
        injection.add_estimate(_estimate(TRACKING), None)
    widths = [fix.position_covariance_ned[0, 0] for fix in bridge.fixes]
    assert widths == pytest.approx([4e-4, 1e-4])
    assert [fix.position_covariance_ned[0, 0] for fix in seen] == pytest.approx([1e-4] * 3)


def test_a_fix_of_the_odometry_says_so():
    bridge = FakeBridge()
    injection = FixInjection(bridge, INSTALLATION)
    for state in (TRACKING, BRIDGING):
        injection.add_estimate(_estimate(state), None)
    assert [fix.by_odometry for fix in bridge.fixes] == [False, True]
    assert bridge.fixes[1].scale_sigma == 0.2


def test_a_judge_that_raises_withholds_and_is_told_and_its_end_too():
    bridge, broken = FakeBridge(), [False]

    def judge(_, fix):
        if broken[0]:
            raise ZeroDivisionError
        return fix

    injection = FixInjection(bridge, INSTALLATION)
    injection.add_check(judge)
    for tenth in range(300):
        broken[0] = 100 <= tenth < 130 or (tenth > 200 and tenth % 2 == 0)
        estimate = replace(_estimate(TRACKING), exposure_time_ns=10**9 + tenth * 10**8)
        injection.add_estimate(estimate, None)
    assert len(bridge.fixes) == 300 - 30 - 49
    assert bridge.said == [
        alert(AlertId.FIXES_NOT_CHECKED), cleared(AlertId.FIXES_NOT_CHECKED),
        alert(AlertId.FIXES_NOT_CHECKED),
    ]  # fmt: skip
