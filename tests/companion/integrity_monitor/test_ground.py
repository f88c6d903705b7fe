"""Height above take-off is not height above the ground, and unknown is not zero."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from companion.calibration_watch.observation import CalibrationObservation, GroundView
from companion.integrity_monitor.config import ProtectionConfig
from companion.integrity_monitor.protection import ProtectionLevel, protection_level
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import VehicleState, VisionFix
from tests.companion.integrity_monitor.simulated import (
    HEIGHT,
    LATITUDE,
    LONGITUDE,
    Flight,
    monitor,
    second,
)
from tests.companion.integrity_monitor.test_checks import Filmed
from tests.companion.integrity_monitor.test_tilt import Tilted, never, valley

DOWN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # NED from a nadir camera
FOV_DEG = 60.0


def sighting(at_s: float, depth_m: float, fov_deg: float = FOV_DEG) -> CalibrationObservation:
    return CalibrationObservation(
        second(at_s), (LATITUDE, LONGITUDE, HEIGHT), 0.1, DOWN, depth_m, fov_deg
    )


def level(relative_m: float | None, seen_m: float | None, **known: object) -> ProtectionLevel:
    """Of a fix of 0.1 m, with the camera's share of an uncalibrated deployment."""
    ground = GroundView(FOV_DEG)
    known = {"local_velocity_ned": (0.0, 0.0, 0.0)} | known
    state = VehicleState(altitude_relative_m=relative_m, **known)  # type: ignore[arg-type]
    if seen_m is not None:
        ground.add(sighting(1.0, seen_m))
    fix = VisionFix(1, LATITUDE, LONGITUDE, HEIGHT, position_covariance_ned=0.01 * np.eye(3))
    return protection_level(
        fix, state, ProtectionConfig(), 0.0, ground.height_m(state, second(2.0))
    )


@pytest.mark.parametrize("relative_m", [None, -60.0, 10.0])
def test_the_ground_that_is_seen_counts_wherever_take_off_was(relative_m: float | None) -> None:
    """From a hill over a valley, 120 m high at 60 m below take-off: what the camera errs by is of
    120 m, and the level was that of an aircraft on the ground.
    """
    assert level(relative_m, 120.0) == level(120.0, None)
    assert level(relative_m, 120.0).horizontal_m > level(0.0, None).horizontal_m + 0.3


@pytest.mark.parametrize("relative_m", [None, -60.0])
def test_a_height_that_nobody_knows_is_taken_for_a_high_one(relative_m: float | None) -> None:
    assert level(relative_m, None).horizontal_m >= level(100.0, None).horizontal_m
    assert level(-1.0, None) == level(0.0, None)  # a barometer's wander before take-off


def test_ground_that_was_seen_long_ago_says_nothing_of_what_is_below() -> None:
    ground, below = GroundView(FOV_DEG), VehicleState(altitude_relative_m=-40.0)
    ground.add(sighting(1.0, 30.0))
    assert ground.height_m(below, second(9.0)) == 30.0
    assert ground.height_m(below, second(12.0)) is None


def test_a_speed_that_nobody_knows_is_not_zero() -> None:
    still = level(60.0, None)
    assert level(60.0, None, local_velocity_ned=None).horizontal_m > still.horizontal_m


@dataclass
class Seen(Flight):
    """A flight whose pictures are registered: `view` is that of the newest."""

    view: CalibrationObservation = field(default_factory=lambda: sighting(0.0, 60.0))
    relative_m: float = 60.0

    def fly(self, until_s: float) -> Flight:
        """On to a time of the flight."""
        self.monitor.add_observation(replace(self.view, time_ns=second(self.at_s)))
        return super().fly(until_s)

    def state(self) -> VehicleState:
        """So high above take-off."""
        return replace(super().state(), altitude_relative_m=self.relative_m)


def stands(at_s: float) -> tuple[float, float]:
    """A path without any motion."""
    return 0.0, 0.0


def test_a_video_that_freezes_below_take_off_is_told() -> None:
    """The check was off below 3 m above take-off: an aircraft on the ground stands still."""
    for relative_m, is_told in ((-40.0, True), (0.4, False)):
        flight = Seen(monitor(), stands, stands, noise_m=0.02, relative_m=relative_m)
        told_s = Filmed(flight, stands).fly(12.0).told(AlertId.VIDEO_FROZEN)
        assert (told_s < 12.0) is is_told


@pytest.mark.parametrize(
    ("fov_deg", "depth_m", "within_s", "not_before_s"),
    [
        (60.0, 100.0, 6.0, 4.0),  # as the camera is configured
        (6.0, 100.0, 3.5, 2.9),  # zoomed in a still picture is sooner one that is frozen,
        (100.0, 100.0, 9.5, 7.0),  # and zoomed out a hover looks still for longer
    ],
)
def test_how_long_a_hover_may_look_still_goes_by_the_zoom(fov_deg, depth_m, within_s, not_before_s):
    watched = monitor(horizontal_fov_deg=FOV_DEG)
    view = sighting(0.0, depth_m, fov_deg)
    flight = Filmed(Seen(watched, stands, stands, noise_m=0.02, view=view), stands).fly(12.0)
    assert not_before_s <= flight.told(AlertId.VIDEO_FROZEN) <= within_s


def test_a_tilt_over_a_valley_below_take_off_is_in_the_level() -> None:
    """4 degrees at 30 m above a valley, 50 m below take-off, had no share in the level."""
    flight = Tilted(monitor(), noise_m=0.05, claimed_m=0.2, vision_deg=valley, above_m=-50.0)
    plain = Tilted(monitor(), noise_m=0.05, claimed_m=0.2, vision_deg=never, above_m=-50.0)
    for tenth in range(1, 120):
        for one in (flight, plain):
            one.monitor.add_observation(sighting(0.1 * tenth, 30.0))
            one.fly(0.1 * tenth)
    tilted, level_one = flight.monitor.level, plain.monitor.level
    assert tilted.horizontal_m > level_one.horizontal_m + 1.0
