"""Frames that turn while the aircraft hovers: their motion is right, their heading is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import Attitude, VisionFix
from mavlink_bridge.quaternion import from_euler
from tests.companion.integrity_monitor.simulated import (
    Flight,
    Path,
    beside,
    hover,
    jumps,
    monitor,
    taken,
    turned,
)

Angle = Callable[[float], float]
SIGMA_DEG = 0.1


def nothing(at_s: float) -> float:
    """No angle."""
    return 0.0


away = beside(hover, lambda _: (120.0, 0.0))  # from home


@dataclass
class Headed(Flight):
    """A flight whose fixes have a heading, which is north; by the time, degrees: what vision's, the
    gyros' and the autopilot's are off.
    """

    vision_deg: Angle = nothing
    gyros_deg: Angle = nothing
    autopilot_deg: Angle = nothing

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """As it is, and with its two headings."""
        attitude = super().attitude_at(time_ns)
        at_s = time_ns * 1e-9
        gyros, own = (float(np.radians(a(at_s))) for a in (self.gyros_deg, self.autopilot_deg))
        return attitude and replace(attitude, gyro_heading_rad=gyros, yaw_rad=own)

    def _fix(self, at_s: float) -> VisionFix:
        yaw = np.radians(self.vision_deg(at_s) + SIGMA_DEG * self._rng.standard_normal())
        fix = super()._fix(at_s)
        q = from_euler(0.0, 0.0, float(yaw))
        return replace(fix, quaternion=q, attitude_sigma_rad=float(np.radians(SIGMA_DEG)))


def headed(seen: Path, **options: object) -> Headed:
    """With the shipped limits."""
    return Headed(monitor(), away, seen, noise_m=0.1, at_s=8.0, **options)  # type: ignore[arg-type]


def turns(degrees: float, until_s: float) -> tuple[Path, Angle]:
    """What a frame shows that turns about home at 12 s, and by how much it is turned."""

    def angle(at_s: float) -> float:
        return degrees if 12.0 <= at_s < until_s else 0.0

    return turned(away, 12.0, until_s, degrees), angle


@pytest.mark.parametrize(("degrees", "silent_s"), [(3.0, 0.0), (-5.0, 6.0)])
def test_a_frame_that_turns_in_a_hover_is_not_taken_by_waiting(degrees, silent_s):
    """It moves as the IMU and the EKF do: it was taken after 5 s, 6 to 120 m aside."""
    seen, angle = turns(degrees, 26.0)
    flight = headed(seen, vision_deg=angle, silent=(12.0, 12.0 + silent_s)).fly(27.0)
    assert flight.told(AlertId.POSITION_JUMP) < 12.3 + silent_s
    assert 26.0 <= taken(flight, 12.0) < 26.2  # the right one, at once


def test_gyros_are_trusted_for_a_minute() -> None:
    """Nobody knows the heading for ever: then a place that moves rightly is taken, announced."""
    seen, angle = turns(5.0, 90.0)
    flight = headed(seen, vision_deg=angle).fly(16.0)
    assert taken(flight, 12.0) == np.inf
    flight.at_s = 70.0
    flight.fly(73.0)
    assert 71.9 <= taken(flight, 12.0) < 72.3
    assert jumps(flight)[0] == pytest.approx(taken(flight, 12.0))


@pytest.mark.parametrize(
    "options",
    [
        {"vision_deg": lambda at_s: 0.2 * max(at_s - 12.0, 0.0)},  # what the gyros drift
        {"gyros_deg": lambda at_s: 40.0 if at_s >= 15.0 else 900.0},  # ATTITUDE lost in a turn
        {"autopilot_deg": lambda at_s: -8.0 if at_s >= 15.0 else 179.9},  # the EKF aligns its yaw
    ],
)
def test_a_place_found_after_a_loss_of_six_seconds_is_taken_after_its_time(options):
    """The wind took it 25 m aside, and the EKF does not know."""
    blown = beside(away, lambda at_s: (0.0, 25.0 if at_s >= 18.0 else 0.0))
    flight = headed(blown, silent=(12.0, 18.0), **options).fly(25.0)
    assert 23.0 <= taken(flight, 12.0) < 23.4
    assert jumps(flight) == [taken(flight, 12.0)]


def test_the_same_place_after_a_loss_of_six_seconds_passes_at_once() -> None:
    """A re-lock where it was, with the heading as it was."""
    flight = headed(away, silent=(12.0, 18.0)).fly(20.0)
    assert taken(flight, 12.0) < 18.2
    assert flight.held == []
    assert flight.lines == []


def test_without_a_heading_motion_and_time_decide() -> None:
    """No attitude, or no gimbal: nothing is known of the turn."""
    seen, _ = turns(5.0, 40.0)
    flight = headed(seen)
    flight.attitude_at = lambda time_ns: None  # type: ignore[method-assign]
    flight.fly(18.0)
    assert 17.0 <= taken(flight, 12.0) < 17.3
