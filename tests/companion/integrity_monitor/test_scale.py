"""Odometry over ground that is not as high as it takes it to be: what the IMU can tell of that."""

import numpy as np
import pytest

from mavlink_bridge.alerts.ids import AlertId
from tests.companion.integrity_monitor.simulated import Flight, Path, monitor

BEGINS_S = 8.0
CLAIM = 0.1


def square(speed: float = 10.0, acceleration: float = 2.5) -> Path:
    """Legs of 100 m from 10 s on, with a stop and a second of hover at each corner."""
    times = np.arange(-1.0, 80.0, 0.02)
    up = speed / acceleration
    whole = up + 100.0 / speed
    leg, since = np.divmod(times - 10.0, whole + 1.0)
    fast = np.clip(np.minimum(since, whole - since) * acceleration, 0.0, speed) * (leg >= 0)
    heading = leg * np.pi / 2.0
    way = np.cumsum(np.stack([fast * np.cos(heading), fast * np.sin(heading)]), axis=1) * 0.02
    return lambda at_s: (
        float(np.interp(at_s, times, way[0])),
        float(np.interp(at_s, times, way[1])),
    )


def straight(at_s: float) -> tuple[float, float]:
    """North at 10 m/s, since long before."""
    return 10.0 * at_s, 0.0


def flown(
    path: Path,
    factor: float,
    seed: int = 1,
    tilt_rad: float = 0.003,
    until_s: float = 40.0,
    within_s: float = 5.0,
    alert_limit_m: float = 10.0,
) -> Flight:
    """With odometry from 8 s on, whose scale goes from 1 to `factor` within some seconds."""
    times = np.arange(0.0, 100.0, 0.02)
    way = np.array([path(t) for t in times])
    factors = 1.0 + (factor - 1.0) * np.clip((times - BEGINS_S) / within_s, 0.0, 1.0)
    steps = np.diff(way, axis=0, prepend=way[:1]) * factors[:, None]
    lie = way[0] + np.cumsum(steps, axis=0)

    def seen(at_s: float) -> tuple[float, float]:
        return float(np.interp(at_s, times, lie[:, 0])), float(np.interp(at_s, times, lie[:, 1]))

    limited = monitor(alert_limit_m=alert_limit_m)
    flight = Flight(limited, path, seen, noise_m=0.05, seed=seed, tilt_rad=tilt_rad)
    flight.fly(BEGINS_S)
    flight.claimed_m, flight.by_odometry = 20.0, True
    return flight.fly(until_s)


@pytest.mark.parametrize(("factor", "limit_m"), [(1.3, 10), (1.5, 10), (0.7, 10), (1.3, 200)])
def test_a_stop_or_a_turn_shows_the_wrong_scale(factor: float, limit_m: float) -> None:
    """Within the first two corners the claim is as wide as the error, or output is held."""
    flight = flown(square(), factor, alert_limit_m=limit_m)
    widest = max([*flight.claims, *(fix.scale_sigma or 0.0 for fix in flight.passed)])
    held = flight.told(AlertId.VISION_IMU_MISMATCH) < 40.0
    assert held or widest == pytest.approx(abs(1.0 - 1.0 / factor), rel=0.3)


@pytest.mark.parametrize(("seed", "tilt_rad"), [(0, 0.009), (1, 0.009), (2, 0.003)])
def test_an_honest_scale_is_left_alone(seed: int, tilt_rad: float) -> None:
    """With the IMU levelled 0.5 degrees wrongly, and 5 % of error within the claim."""
    flight = flown(square(), 0.95 + 0.05 * seed, seed, tilt_rad)
    assert {alert.id for _, alert in flight.lines} == {AlertId.HPL_OVER_LIMIT}
    assert set(flight.claims) == {CLAIM}


def test_in_straight_flight_nothing_shows_the_scale() -> None:
    """1.3 times the velocity, within 20 s: as an IMU that is tilted by 0.9 degrees. The claim by
    the height above the ground is all there is.
    """
    flight = flown(straight, 1.3, until_s=40.0, within_s=20.0)
    assert set(flight.claims) == {CLAIM}
