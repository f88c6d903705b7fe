"""What is judged of a followed car: every fault is found, no other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.synth.world import WorldInfo
from sitl.demo.assets import FlightAssets
from sitl.errors import SimulationError
from sitl.operator.follow_run import FollowedFix, follow_verdict
from sitl.operator.pursuer import SPEED_MPS, Chase, Pursuer, make_chase, pursuit

SECOND = 10**9
CAMERA = Camera.from_fov(320, 240, 60.0)


@pytest.fixture
def chase(small_assets: FlightAssets) -> Chase:
    world = small_assets.world
    lane = np.column_stack([np.arange(-400.0, 401.0, 10.0), np.zeros(81), np.zeros(81)])
    longer: WorldInfo = replace(world, roads=(lane,))
    return make_chase(longer, world.frame, SECOND, 5.0)


def test_an_operator_who_cannot_begin_fails_the_flight(small_assets: FlightAssets) -> None:
    """Without its link the thread died with a traceback, and the flight had no operator."""
    pursuer = Pursuer(small_assets, CAMERA, 100.0, 0)
    vehicle: Any = SimpleNamespace(spare_endpoint="nonsense", check=None)
    pilot: Any = None
    with pursuer.take_part(vehicle, pilot, Path("frames.csv")):
        pass
    assert pursuer.failure


def test_a_world_without_a_long_road_is_a_named_error(small_assets: FlightAssets) -> None:
    world = replace(small_assets.world, roads=())
    with pytest.raises(SimulationError, match="no road"):
        make_chase(world, world.frame, SECOND, 5.0)


def fixes(chase: Chase, until_s: float = 60.0, off_m: float = 0.3) -> list[FollowedFix]:
    found = []
    for s in np.arange(0.0, until_s, 0.25):
        time_ns = chase.begins_ns() + round(s * SECOND)
        hidden = any(a <= time_ns <= b for a, b in chase.hidden_ns())
        place = chase.car.position_at(time_ns) + np.array([off_m, 0.0, 0.0])
        velocity = chase.car.velocity_at(time_ns)
        P = 0.04 * np.eye(3)
        found.append(FollowedFix(time_ns, place, P, velocity, not hidden))
    return found


def test_a_car_that_is_followed_through_both_roofs(chase: Chase) -> None:
    end_ns = chase.begins_ns() + 60 * SECOND
    verdict = follow_verdict(fixes(chase), chase, end_ns)
    assert verdict.is_followed, verdict.why
    assert verdict.p95_m == pytest.approx(0.3, abs=1e-6)
    assert verdict.velocity_p95_mps == pytest.approx(0.0, abs=1e-6)
    assert len(verdict.back_s) == 2
    for begin, end in chase.hidden_ns():  # so long that the whole car is out of sight for 2 s
        assert (end - begin) * 1e-9 == pytest.approx(2.0 + 4.5 / SPEED_MPS, abs=0.01)
    above = pursuit(chase.car, end_ns, 90.0, 25.0) - chase.car.position_at(end_ns)
    assert above[2] == pytest.approx(90.0, abs=1.0)


def test_each_way_of_losing_it_is_told(chase: Chase) -> None:
    end_ns = chase.begins_ns() + 60 * SECOND
    lost = follow_verdict(fixes(chase, 30.0), chase, end_ns)
    assert any("last seen 29" in why for why in lost.why)
    other = [replace(f, position=f.position + 9.0) for f in fixes(chase)[-8:]]
    foreign = follow_verdict([*fixes(chase), *other], chase, end_ns)
    assert "8 reports are of something else" in foreign.why
    late = chase.hidden_ns()[0][1] + 4 * SECOND
    gap = [f for f in fixes(chase) if not chase.hidden_ns()[0][0] < f.time_ns < late]
    assert any("after a roof" in why for why in follow_verdict(gap, chase, end_ns).why)
    assert not follow_verdict([], chase, end_ns).is_followed
