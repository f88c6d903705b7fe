"""Traffic stands on the ground, keeps to its lanes, and is known by its arguments."""

from __future__ import annotations

import numpy as np
import pytest

from localizer.geometry.geo import Geodetic
from localizer.synth.plan.terrain import River, Terrain
from localizer.synth.world import WorldInfo
from sitl.camera.traffic import traffic

ORIGIN = Geodetic(47.3, 8.4, 450.0)
SECOND = 10**9


@pytest.fixture
def world() -> WorldInfo:
    """A slope of 10 % to the east with one lane to the north at x = 2.2."""
    heights = np.tile(0.1 * (np.arange(41) * 20.0 - 400.0), (41, 1))
    none = River(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    y = np.arange(-300.0, 301.0, 4.0)
    lane = np.column_stack([np.full(len(y), 2.2), y, np.zeros(len(y))])
    return WorldInfo(0, "live", 800.0, ORIGIN, 47.5, (), (lane,), 0, Terrain(heights, 20.0, none))


def test_cars_drive_on_the_right_and_people_walk_beside_the_road(world: WorldInfo) -> None:
    movers = traffic(world, world.frame, cars=12, people=12, seed=2)
    assert [m.name for m in movers[:2]] == ["car0", "car1"]
    for mover in movers:
        for t in range(0, 60 * SECOND, 7 * SECOND):
            east, north, up = mover.position_at(t)
            if abs(north) > 290:  # where they turn round
                continue
            going_north = mover.velocity_at(t)[1] > 0
            beside = 2.2 if mover.name.startswith("car") else 6.2
            assert east == pytest.approx(beside if going_north else -beside, abs=1e-6)
            assert up == pytest.approx(0.1 * east, abs=1e-3)
            speed = np.linalg.norm(mover.velocity_at(t))
            assert 7 <= speed <= 14 if mover.name.startswith("car") else 1 <= speed <= 1.7


def test_the_same_arguments_give_the_same_truth_and_the_epoch_shifts_it(world: WorldInfo) -> None:
    a = traffic(world, world.frame, cars=3, people=0, seed=5)
    b = traffic(world, world.frame, cars=3, people=0, seed=5, epoch_ns=100 * SECOND)
    for first, second in zip(a, b, strict=True):
        np.testing.assert_allclose(
            first.position_at(9 * SECOND), second.position_at(109 * SECOND), atol=1e-9
        )
