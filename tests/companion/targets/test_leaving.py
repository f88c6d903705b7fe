"""A clicked car that stood and is gone: its old place is not told as if it were seen there."""

import numpy as np

from localizer.types import Visibility
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from tests.companion.targets.test_following import Crossing, Watcher, click, watching

AWAY = ((500.0, 500.0), 0.0)
PLACE = (-26.0, -14.5)


def _told(until_s, gone_s=np.inf, back_s=np.inf):
    """A car at its place, but for between two times; it is clicked at after 0.8 s."""

    def car(time_s):
        return AWAY if gone_s < time_s < back_s else (PLACE, 0.0)

    watcher = Watcher(Crossing(car), until_s, watching, 0.02)
    watcher.fly(8)
    click(watcher, lambda _: (*PLACE, 0.0))
    watcher.fly(round(10 * until_s) - 8)
    return watcher, [(t.fix, t.estimate.exposure_time_ns * 1e-9) for t in watcher.of(1)]


def test_a_parked_car_that_is_gone_may_have_left_until_its_place_looks_as_it_did():
    """Of a grey car beside a zebra crossing a template shows the crossing, which stays."""
    watcher, told = _told(8.2, gone_s=2.4, back_s=7.6)
    assert watcher.alerts[1:] == [
        alert(AlertId.TARGET_MAY_HAVE_LEFT, number=1), alert(AlertId.TARGET_BACK, number=1),
    ]  # fmt: skip
    before = [f for f, s in told if s < 2.4]
    gone = [f for f, s in told if 7.4 < s < 7.6]
    assert {f.visibility for f in before} <= {Visibility.SEEN, Visibility.HELD}
    assert {f.visibility for f in gone} == {Visibility.HIDDEN}
    assert gone[-1].covariance[0, 0] > 10.0 * before[-1].covariance[0, 0]
    last = told[-1][0]
    assert last.visibility is Visibility.HELD
    assert last.covariance[0, 0] < 1.1 * before[-1].covariance[0, 0]
    assert all(f.velocity is None for f, _ in told)


def test_a_car_that_stays_parked_has_not_left():
    watcher, told = _told(4.0)
    assert len(watcher.alerts) == 1
    assert all(f.visibility is not Visibility.HIDDEN for f, _ in told)
