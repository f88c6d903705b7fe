"""Jumps that are held, what comes back behind them, and steps that are none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import VehicleState
from tests.companion.integrity_monitor.simulated import (
    Flight,
    Path,
    beside,
    jumps,
    leg,
    monitor,
    swung,
    taken,
    turned,
)

Velocity = tuple[float, float]


@dataclass
class Reckoned(Flight):
    """A flight whose EKF knows its velocity with an error (north, east, m/s), by the time."""

    error: Callable[[float], Velocity] = lambda at_s: (0.0, 0.0)

    def state(self) -> VehicleState:
        """As it is, but for the velocity."""
        state = super().state()
        north, east, down = state.local_velocity_ned or (0.0, 0.0, 0.0)
        off = self.error(self.at_s)
        return replace(state, local_velocity_ned=(north + off[0], east + off[1], down))


def cruise(at_s: float) -> tuple[float, float]:
    """10 m/s northwards."""
    return 10.0 * at_s, 0.0


def drifting(since_s: float) -> Callable[[float], Velocity]:
    """An EKF without positions: 0.2 m/s wrong, and 0.1 m/s more each second."""

    def error(at_s: float) -> Velocity:
        alone_s = max(at_s - since_s, 0.0)
        return (-0.2 - 0.1 * alone_s, 0.1) if alone_s else (0.0, 0.0)

    return error


@pytest.mark.parametrize(("until_s", "seed"), [(16.0, 1), (16.0, 2), (19.5, 3)])
def test_a_turned_frame_never_passes_by_waiting_and_the_right_one_passes_at_once(until_s, seed):
    """`frame-rotates` (ArduPilot) ended in LAND: what a held position may be off grew while it was
    held, so after 3.8 s the turned one passed, and the right one behind it was held for 5 s more.
    """
    seen = turned(cruise, 12.0, until_s)
    flight = Reckoned(
        monitor(), cruise, seen, noise_m=0.3, claimed_m=0.3, seed=seed, error=drifting(12.0)
    ).fly(until_s + 4.0)
    assert flight.told(AlertId.POSITION_JUMP) < 12.3
    assert until_s <= taken(flight, 12.0) < until_s + 0.2  # the monitor's next turn
    assert max(flight.held) < until_s + 0.1
    assert jumps(flight) == [taken(flight, 12.0)]


def test_a_right_place_is_taken_though_the_ekf_drifts() -> None:
    """What passed before was 8 m aside: after 5 s the right one is believed, and announced."""
    relocalized = beside(cruise, lambda at_s: (0.0, 8.0 if at_s < 12.0 else 0.0))
    flight = Reckoned(monitor(), cruise, relocalized, error=drifting(12.0)).fly(20.0)
    assert 17.0 <= taken(flight, 12.0) < 17.3
    assert jumps(flight) == [taken(flight, 12.0)]


def test_a_right_place_is_taken_in_the_end_though_the_ekf_stands() -> None:
    """An EKF without positions may give up its velocity: it contradicts for 10 s, not for good."""
    relocalized = beside(cruise, lambda at_s: (0.0, 20.0 if at_s < 12.0 else 0.0))

    def gives_up(at_s: float) -> Velocity:
        return (-10.0, 0.0) if at_s >= 14.0 else (0.0, 0.0)

    flight = Reckoned(monitor(), cruise, relocalized, error=gives_up).fly(26.0)
    assert 17.0 <= taken(flight, 12.0) < 22.3


def test_what_alternates_proves_nothing_and_the_right_one_passes_each_time() -> None:
    """Two likely places, a second each: neither lends its time to the other."""

    def is_wrong(at_s: float) -> bool:
        return int(at_s) % 2 == 0

    aside = beside(cruise, lambda at_s: (0.0, 12.0 if at_s >= 12.0 and is_wrong(at_s) else 0.0))
    flight = Reckoned(monitor(), cruise, aside, noise_m=0.1, claimed_m=0.1).fly(24.0)
    wrong = {tenth / 10 for tenth in range(120, 240) if is_wrong(tenth / 10)}
    next_turn = {13.0, 15.0, 17.0, 19.0, 21.0, 23.0}
    assert {round(at_s, 1) for at_s in flight.held} == wrong | next_turn


def test_after_a_gap_in_wind_the_place_found_passes() -> None:
    """20 s without a fix: the EKF is 40 m off, and the way may have turned."""
    flight = Reckoned(
        monitor(), cruise, error=drifting(12.0), silent=(12.0, 32.0), reset_at_s=32.0
    ).fly(34.0)
    assert taken(flight, 12.0) == pytest.approx(32.0)
    assert flight.held == []


def test_without_the_ekfs_velocity_what_is_held_is_taken_after_its_time() -> None:
    """Nothing leads, nothing contradicts; what it may be off grows, as nobody knows more."""

    class Mute(Reckoned):
        def state(self) -> VehicleState:
            return replace(super().state(), local_velocity_ned=None)

    flight = Mute(
        monitor(), lambda at_s: (0.0, 0.0), lambda at_s: (30.0 if at_s >= 12.0 else 0.0, 0.0)
    ).fly(18.0)
    assert 17.0 <= taken(flight, 12.0) < 17.3


def test_an_announced_jump_that_does_not_move_is_never_taken() -> None:
    """A jump that is announced again with each fix that is withheld began its evidence anew with
    each: nothing was settled, so nothing spoke against it, and it was taken after its time.
    """

    def elsewhere(at_s: float) -> tuple[float, float]:
        return swung(at_s) if at_s < 12.0 else (200.0, 60.0)

    flight = Flight(monitor(), swung, elsewhere, noise_m=0.03, reset_at_s=12.0).fly(34.0)
    assert flight.told(AlertId.POSITION_JUMP) < 12.3
    assert taken(flight, 12.0) == np.inf


@pytest.mark.parametrize("path", [leg, lambda at_s: (0.0, 0.0)])
def test_one_fix_far_off_is_no_step(path: Path) -> None:
    """`frame-rotates` (ArduPilot, vision only): "position stepped 2 m" at take-off in 3 of 5: two
    fixes of sigma 0.3 m, 1.9 m apart, once in 8000. What is a step lasts.
    """
    once = beside(path, lambda at_s: (0.0, 1.2 if abs(at_s - 12.0) < 0.05 else 0.0))
    flight = Flight(monitor(), path, once, noise_m=0.05, claimed_m=0.1).fly(16.0)
    assert flight.lines == []
    assert flight.held == []
    level = [fix.protection_m[0] for fix in flight.passed if fix.protection_m is not None]
    assert max(level) > level[100] + 1.0  # until it is known
    assert level[-1] == pytest.approx(level[100], abs=0.01)


def test_an_ekf_that_flew_on_alone_makes_no_step_of_what_is_found() -> None:
    """fog-bank (ArduPilot): found again to 0.3 m, and told as a step of 3 m: the EKF's velocity was
    off by 15 m/s.
    """

    def alone(at_s: float) -> Velocity:
        return (15.0, -9.0) if 12.0 <= at_s < 33.5 else (0.0, 0.0)

    flight = Reckoned(
        monitor(), cruise, noise_m=0.1, claimed_m=0.12, error=alone,
        silent=(12.0, 32.0), reset_at_s=32.0,
    ).fly(36.0)  # fmt: skip
    assert flight.times(AlertId.POSITION_STEP) == []
    assert flight.held == []
    level = [fix.protection_m[0] for fix in flight.passed if fix.protection_m is not None]
    assert level[-1] == pytest.approx(level[100], abs=0.1)


def test_noise_as_it_is_claimed_is_no_step() -> None:
    """Of ten minutes at sigma 0.3 m those seconds where two fixes are the farthest apart: 2.1 m."""
    noise = 0.3 * np.random.default_rng(26).standard_normal((6000, 2))
    apart = np.hypot(*np.diff(noise, axis=0).T)
    assert apart.max() > 2.1

    def seen(at_s: float) -> tuple[float, float]:
        north, east = noise[round(at_s * 10.0)]
        return float(north), float(east)

    worst = int(np.argmax(apart)) * 0.1
    flight = Flight(monitor(), lambda at_s: (0.0, 0.0), seen, noise_m=0.0, claimed_m=0.3)
    flight.at_s = max(worst - 8.0, 0.0)
    flight.fly(worst + 3.0)
    assert flight.lines == []
