"""Positions that follow a tilt: low down the two look alike, and gravity knows better."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from companion.integrity_monitor.position_checks import TiltCheck
from companion.integrity_monitor.step import UNREPORTED_JUMP_M
from mavlink_bridge.alerts.catalogue import cleared
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import Attitude, VehicleState, VisionFix
from mavlink_bridge.quaternion import from_euler
from tests.companion.integrity_monitor.simulated import Flight, leg, monitor, outside, second

Angle = Callable[[float], float]
LEVEL = Attitude(0, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0))
CLAIMED_DEG = 0.3


def valley(at_s: float) -> float:
    """Degrees that vision's pitch leaves the truth by, from the first fix on, and back."""
    return float(np.interp(at_s, [0.0, 3.0, 9.0, 13.0, 16.0], [0.0, 2.2, 3.7, 4.0, 0.0]))


def never(at_s: float) -> float:
    """No tilt."""
    return 0.0


@dataclass
class Tilted(Flight):
    """A flight low over the ground whose fixes have an attitude. vision_deg: its pitch's error,
    which shifts the position with it; gimbal_deg: what autopilot and gimbal err by in pitch; heard:
    whether the autopilot's attitude is known at a time, seconds.
    """

    vision_deg: Angle = never
    gimbal_deg: float = 0.5
    above_m: float = 30.0
    heard: Callable[[float], bool] = lambda at_s: True

    def state(self) -> VehicleState:
        """So high."""
        return replace(super().state(), altitude_relative_m=self.above_m)

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """None where it is missing."""
        return super().attitude_at(time_ns) if self.heard(time_ns * 1e-9) else None

    def _fix(self, at_s: float) -> VisionFix:
        pitch = self.tilt_rad + np.radians(self.vision_deg(at_s) - self.gimbal_deg)
        sigma = float(np.radians(CLAIMED_DEG))
        fix = replace(super()._fix(at_s), attitude_sigma_rad=sigma)
        return replace(fix, quaternion=from_euler(0.0, float(pitch), 0.0))


def low(vision_deg: Angle = never, above_m: float = 30.0, **options: Any) -> Tilted:
    """With the shipped limits; what is seen is shifted by the tilt times the height."""

    def seen(at_s: float) -> tuple[float, float]:
        north, east = leg(at_s)
        return north + above_m * np.tan(np.radians(vision_deg(at_s))), east

    return Tilted(
        monitor(), leg, seen, noise_m=0.05, claimed_m=0.2, vision_deg=vision_deg,
        above_m=above_m, **options,
    )  # fmt: skip


def test_a_shift_that_follows_a_tilt_is_told_and_inside_the_level() -> None:
    """`begins-denied` at 30 m: 4 degrees and 2.7 m for ten seconds, under a level of 1.2 m."""
    flight = low(valley).fly(20.0)
    assert flight.told(AlertId.TILT_MISMATCH) <= 9.0
    assert outside(flight) == []
    assert flight.held == []
    assert flight.lines[-1][1] == cleared(AlertId.TILT_MISMATCH)
    assert flight.passed[-1].protection_m == pytest.approx(flight.passed[0].protection_m, abs=0.1)


def test_a_gimbal_that_is_knocked_costs_no_position() -> None:
    """8 degrees at 120 m would be 17 m: told, and the level is widened, but nothing is withheld."""
    flight = low(gimbal_deg=8.0, above_m=120.0).fly(6.0)
    assert flight.told(AlertId.TILT_MISMATCH) < 3.0
    assert flight.held == []


def fixes(seed: int, constant_deg: float, wander_deg: float, seconds: int) -> Iterator[VisionFix]:
    """Ten a second; the gimbal's alignment, its wander (6 s) and vision's noise in their angles."""
    rng = np.random.default_rng(seed)
    aligned = np.radians(constant_deg) * rng.standard_normal(2)
    kept = np.exp(-0.1 / 6.0)
    wander = np.radians(wander_deg) * rng.standard_normal(2)
    sigma = float(np.radians(CLAIMED_DEG))
    for k in range(10 * seconds):
        drive = np.radians(wander_deg) * np.sqrt(1.0 - kept**2)
        wander = kept * wander + drive * rng.standard_normal(2)
        roll, pitch = aligned + wander + 0.5 * sigma * rng.standard_normal(2)
        yield VisionFix(
            second(0.1 * k), 47.4, 8.5, 535.0, from_euler(float(roll), float(pitch), 0.0),
            attitude_sigma_rad=sigma,
        )  # fmt: skip


@pytest.mark.parametrize("seed", range(10))
def test_a_gimbal_that_is_off_and_wanders_is_left_alone(seed: int) -> None:
    """Half a degree that stays and 0.3 that wander, per axis, drawn for ten flights."""
    check = TiltCheck()
    for fix in fixes(seed, 0.5, 0.3, 60):
        check.add(fix, LEVEL)
        assert not check.tilts


def test_a_tilt_is_not_over_because_the_attitude_is_gone() -> None:
    """The attitude ends at 10 s, and what it said of the position was forgotten with it."""
    flight = low(valley, heard=lambda at_s: at_s < 10.0).fly(13.0)
    assert flight.told(AlertId.TILT_MISMATCH) <= 9.0
    assert flight.ended(AlertId.TILT_MISMATCH) == np.inf
    assert outside(flight) == []


def test_a_tilt_is_told_and_bounded_by_every_other_attitude() -> None:
    """A link that loses some must not hide it."""
    flight = low(valley, heard=lambda at_s: round(10.0 * at_s) % 2 == 0).fly(12.5)
    assert flight.told(AlertId.TILT_MISMATCH) <= 9.0
    assert outside(flight) == []


def test_attitudes_that_are_missing_are_no_tilt() -> None:
    """Whether some or all, of a flight that is right."""
    for heard in (lambda at_s: round(10.0 * at_s) % 3 == 0, lambda at_s: at_s > 4.0):
        flight = low(heard=heard).fly(8.0)
        assert flight.told(AlertId.TILT_MISMATCH) == np.inf
        assert flight.held == []


def test_a_tilt_at_an_unknown_height_is_widened() -> None:
    """A vehicle without a home says no height, and its position was taken to be right."""
    check = TiltCheck()
    for fix in fixes(1, 0.0, 0.0, 1):
        check.add(replace(fix, quaternion=from_euler(0.0, 0.1, 0.0)), LEVEL)
    assert check.metres(None) == UNREPORTED_JUMP_M
    for fix in fixes(1, 0.5, 0.3, 1):
        check.add(fix, LEVEL)
    assert check.metres(None) == 0.0


def test_without_an_attitude_nothing_is_said() -> None:
    """No attitude of the camera: no evidence."""
    check = TiltCheck()
    for fix in fixes(1, 20.0, 0.3, 2):
        check.add(fix, None)
        check.add(replace(fix, quaternion=None), LEVEL)
    assert not check.tilts
    assert check.metres(30.0) == 0.0
