from typing import Any

import numpy as np
import pytest

from benchmarks.targets.clicks import clicked, row
from benchmarks.targets.flights import PoseErrors, steps
from localizer.geometry.pose import Pose
from localizer.map.cache.pick import cast_bundle
from tests.companion.targets.scene import CAMERA, DOWN, cast, square


def test_a_click_is_held_against_today_and_wrong_maps_are_counted():
    path = [(10**9, Pose(DOWN, np.array([0.0, 0.0, 100.0])))]
    (step,) = steps(path, CAMERA, PoseErrors(0.01, 0.001), np.random.default_rng(0))

    def today(origin, directions):  # the roof is gone
        return cast_bundle([square(2000.0, 0.0)], origin, directions)

    rng = np.random.default_rng(1)
    same = [t for _ in range(40) if (t := clicked(step, cast, cast, rng)) is not None]
    gone = [t for _ in range(40) if (t := clicked(step, cast, today, rng)) is not None]
    right: dict[str, Any] = row("same", same)
    wrong: dict[str, Any] = row("gone", gone)
    assert right["inside_95_percent"] == 100.0
    assert right["max_m"] < 1.0 or any(t.elsewhere for t in same)
    assert wrong["beyond_3_m_with_sigma_below_1_m"] > 0
    assert wrong["inside_95_percent"] < 100.0
    assert {t.middle for t in same} == {True, False}
    assert max(t.distance_m for t in gone) == pytest.approx(100.0, rel=0.4)
