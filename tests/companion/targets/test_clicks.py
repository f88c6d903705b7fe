"""Clicks through the targets' thread; what they mean is in test_operator.py."""

import itertools
from typing import Any

import numpy as np
import pytest

from companion.config import TargetConfig
from companion.targets.clicks import ClickPolicy
from companion.targets.reporter import TargetReporter
from localizer.map.cache.pick import BundleHits
from localizer.types import TrackingState
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.messages import TrackRequest
from tests.companion.estimates import estimated


class Ground:
    """A ground station that clicks into frames of a camera 100 m above flat ground."""

    def __init__(self):
        self.targets: list[Any] = []
        self.alerts: list[Any] = []
        self.gone: list[Any] = []
        config = TargetConfig(operator_delay_ms=0.0)
        self.numbers = itertools.count(1)
        self.reporter = TargetReporter(config, flat, self.targets.append, on_gone=self.gone.append)
        self.clicks = ClickPolicy(self.reporter, self.alerts.append, config)
        self.reporter.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.reporter.stop()

    def sees(self, time_ns, state=TrackingState.TRACKING):
        estimate = estimated(time_ns=time_ns, state=state)
        self.clicks.add_estimate(estimate)
        self.reporter.add_estimate(estimate)

    def clicks_at(self, x, y, time_ns):
        self.clicks.on_request(TrackRequest("point", time_ns, (x, y), number=next(self.numbers)))

    def has(self, count):
        """Whether so many targets were told (each once: no other frame came since)."""
        return sleep_until(lambda: len({t.fix.target_id for t in self.targets}) >= count, 30.0)


MS = 1_000_000


def flat(origin, directions):
    return BundleHits(-origin[2] / directions[:, 2], np.tile([0.0, 0.0, 1.0], (len(directions), 1)))


def test_a_second_click_is_a_second_target():
    """A, then B 60 m away: B was reported as A, twice, and then with A's way to B as velocity."""
    with Ground() as ground:
        for k, x in enumerate((0.25, 0.25 + 0.52, 0.25, 0.25 + 0.52)):
            ground.sees(k * 400 * MS)
            ground.clicks_at(x, 0.5, k * 400 * MS + 10)
            assert ground.has(k + 1)
        places = {
            t.fix.target_id: tuple(np.round(t.fix.position_world[:2])) for t in ground.targets
        }
        a, b = list(places.values())[:2]
        assert b[0] - a[0] == pytest.approx(60.0, abs=1.0)
        assert list(places.values()) == [a, b, a, b]
        assert all(t.velocity is None for t in ground.targets)
