"""Who flies along with a car and clicks at it: once, in time, at the car, or it says why not."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from localizer.geometry.pose import Pose
from localizer.synth.world import WorldInfo
from sitl.camera.world_camera import FrameLog
from sitl.demo.assets import FlightAssets
from sitl.operator.chase import SPEED_MPS, Chase, make_chase, pursuit
from sitl.operator.pursuer import FOLLOWED_S, LATE_S, Pursuer
from tests.companion.targets.scene import CAMERA, DOWN

SECOND = 10**9
HEIGHT_M = 100.0
PERIOD_NS = SECOND // 10
NUMBER = 7


@dataclass
class Flight:
    """A vehicle that is where it is sent to, its camera's log, and a clock that only it moves on.

    aside_m: of the aircraft from the car, along x, beyond what the pursuer asks for; ends_ns: of
    the whole flight.
    """

    log: FrameLog
    aside_m: float = 0.0
    ends_ns: int = 1 << 62
    now_ns: int = SECOND
    chase: Chase | None = None
    places: list[np.ndarray] = field(default_factory=list)
    asked: list[tuple[int, float, float]] = field(default_factory=list)
    closed: int = 0
    _pictures: int = 0

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.pass_until(self.now_ns + round(seconds * SECOND))

    def pass_until(self, until_ns: int) -> None:
        """A picture every tenth of a second, of what lies under the aircraft."""
        while self.now_ns < until_ns:
            self.now_ns = min(self.now_ns + PERIOD_NS, until_ns)
            assert self.chase is not None
            place = pursuit(self.chase.car, self.now_ns, HEIGHT_M, 12.0)
            place = place + np.array([self.aside_m, 0.0, 0.0])
            self._pictures += 1
            # Stamped 40 ms late: what was clicked at is known by the true exposure.
            self.log.add(self._pictures, self.now_ns + 40_000_000, Pose(DOWN, place), self.now_ns)

    def go_to(self, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
        self.places.append(np.array([latitude_deg, longitude_deg, height_m]))

    def station(self, _endpoint: str, _alive: Callable[[], None]) -> Any:
        return SimpleNamespace(run_until=self._run_until, track=self._track, close=self._close)

    def _run_until(self, done: Callable[[], bool], until_ns: int) -> bool:
        self.pass_until(until_ns)
        return done() or self.now_ns >= self.ends_ns

    def _track(self, x: float, y: float) -> tuple[int, int]:
        self.asked.append((self.now_ns, x, y))
        return 0, NUMBER

    def _close(self) -> None:
        self.closed += 1


@pytest.fixture
def assets(small_assets: FlightAssets) -> FlightAssets:
    """The small world with a road that is long enough."""
    lane = np.column_stack([np.arange(-400.0, 401.0, 10.0), np.zeros(81), np.zeros(81)])
    longer: WorldInfo = replace(small_assets.world, roads=(lane,))
    return replace(small_assets, world=longer)


@contextmanager
def flown(
    assets: FlightAssets, path: Path, monkeypatch: pytest.MonkeyPatch, **options: Any
) -> Iterator[tuple[Pursuer, Flight]]:
    """A pursuer whose ride is over."""
    with FrameLog(path / "frames.csv") as log:
        flight = Flight(log, **options)
        monkeypatch.setattr("sitl.operator.pursuer.time", flight)
        monkeypatch.setattr("sitl.operator.pursuer.Station", flight.station)
        monkeypatch.setattr(
            "sitl.operator.pursuer.make_chase",
            lambda world, frame, epoch_ns, _lead_s, seed: make_chase(
                world, frame, epoch_ns, 5.0, seed
            ),
        )
        pursuer = Pursuer(assets, CAMERA, HEIGHT_M, seed=3)
        pursuer.movers(SECOND)
        flight.chase = pursuer.chase
        vehicle = SimpleNamespace(spare_endpoint="", check=lambda: None)
        cabin = SimpleNamespace(vehicle=vehicle, frames=path / "frames.csv", pilot=flight)
        before = set(threading.enumerate())
        with pursuer.ride(cabin):  # type: ignore[arg-type]
            for thread in set(threading.enumerate()) - before:
                thread.join(60.0)
        yield pursuer, flight


def test_it_clicks_once_at_the_car_as_late_as_an_operator_and_flies_along(
    assets: FlightAssets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with flown(assets, tmp_path, monkeypatch) as (pursuer, flight):
        assert pursuer.failure == ""
        assert pursuer.number == NUMBER
        chase = pursuer.chase
        assert chase is not None
        ((clicked_ns, x, y),) = flight.asked
        # The picture of the moment when the car is where it is clicked at, seen so much later.
        assert clicked_ns == chase.begins_ns() + round(LATE_S * SECOND)
        assert pursuer.late_s == pytest.approx(LATE_S)
        eye = pursuit(chase.car, chase.begins_ns(), HEIGHT_M, 12.0)
        top = chase.car.position_at(chase.begins_ns()) + np.array([0.0, 0.0, 0.75])
        pixel, _ = CAMERA.project(Pose(DOWN, eye).inverse.apply(top))
        off = np.array([x * CAMERA.width, y * CAMERA.height]) - pixel
        assert 0.0 < np.hypot(*off) < 6.0  # a hand's error
        # Sent to where the car will be, to the end of the minute.
        assert flight.now_ns == pursuer.end_ns == chase.begins_ns() + round(FOLLOWED_S * SECOND)
        assert pursuer.chase is not None
        home_m = flight.places[-1][2] - HEIGHT_M
        assert abs(home_m) < 30.0
        moved = len(flight.places) * 0.4 * SPEED_MPS
        assert moved > 0.9 * FOLLOWED_S * SPEED_MPS
        assert flight.closed == 1


def test_an_aircraft_that_is_late_or_elsewhere_says_so_and_clicks_nowhere(
    assets: FlightAssets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with flown(assets, tmp_path / "a", monkeypatch, now_ns=20 * SECOND) as (pursuer, flight):
        assert "had gone by" in pursuer.failure
        assert (flight.asked, pursuer.number, flight.closed) == ([], 0, 1)
    with flown(assets, tmp_path / "b", monkeypatch, aside_m=300.0) as (pursuer, flight):
        assert "not in the picture" in pursuer.failure
        assert (flight.asked, pursuer.number, flight.closed) == ([], 0, 1)


def test_a_flight_that_ends_before_is_no_click(
    assets: FlightAssets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with flown(assets, tmp_path, monkeypatch, ends_ns=2 * SECOND) as (pursuer, flight):
        assert (flight.asked, pursuer.number, flight.closed) == ([], 0, 1)
