"""The figures for a station's plots: right values, nothing invented, nothing after a loss."""

import threading

import numpy as np
import pytest

from companion.ground.vital_signs import VitalSigns
from localizer.types import TrackingState
from tests.companion.estimates import estimated

SECOND = 10**9


def estimate(time_ns, *, accepted=True, state=TrackingState.TRACKING, sigma=0.3):
    covariance = np.diag([sigma**2, sigma**2, 1.0, 0.0, 0.0, 0.0])
    said = {"covariance": covariance, "quality": 0.8, "state": state, "accepted": accepted}
    return estimated(time_ns=time_ns, **said)


def test_what_a_good_flight_says():
    signs = VitalSigns(lambda _: None)
    for k in range(60):
        signs.add_estimate(estimate(k * SECOND // 10, accepted=k % 2 == 0))
    told = signs.figures(6 * SECOND)
    assert told["VPS_SIGNAL"] == 2.0
    assert told["VPS_RATE"] == pytest.approx(5.0, abs=0.21)
    assert told["VPS_AGE"] == pytest.approx(0.2)
    assert told["VPS_SIGMA"] == pytest.approx(0.3 * np.sqrt(2))
    assert told["VPS_QUAL"] == pytest.approx(0.8)
    assert all(len(name) <= 10 for name in told)


@pytest.mark.parametrize(
    ("state", "age_s", "signal"),
    [
        (TrackingState.BRIDGING, 0.1, 1.0),
        (TrackingState.INITIALIZING, 0.1, 1.0),
        (TrackingState.TRACKING, 2.5, 0.0),
        (TrackingState.LOST, 0.1, 0.0),
    ],
)
def test_a_signal_is_claimed_only_of_what_is_fresh_and_sure(state, age_s, signal):
    signs = VitalSigns(lambda _: None)
    signs.add_estimate(estimate(SECOND))
    signs.add_estimate(estimate(SECOND + 1, accepted=False, state=state))
    assert signs.figures(round((1 + age_s) * SECOND))["VPS_SIGNAL"] == signal


def test_before_the_first_position_nothing_is_invented():
    signs = VitalSigns(lambda _: None)
    signs.add_estimate(estimate(SECOND, accepted=False, state=TrackingState.INITIALIZING))
    assert signs.figures(2 * SECOND) == {"VPS_SIGNAL": 0.0, "VPS_RATE": 0.0}


def test_a_bridge_that_refuses_does_not_end_the_telling(monkeypatch):
    monkeypatch.setattr("companion.ground.vital_signs._PERIOD_S", 0.01)
    told, again = [], threading.Event()

    def tell(figures):
        told.append(figures)
        if len(told) == 1:
            raise OSError("link")
        again.set()

    signs = VitalSigns(tell)
    signs.start()
    assert again.wait(30.0)
    signs.stop()
