"""The target's tracks: motion, outliers, and two surfaces that must not be averaged."""

import numpy as np
import pytest

from localizer.targets.filter import TargetFilter
from localizer.types import TargetSighting, TargetSurface

ROOF, GROUND = np.array([1.8, -1.0, 4.3]), np.zeros(3)


def _sighting(k: float, *surfaces, rate_hz: float = 5.0) -> TargetSighting:
    """The k-th sighting; surfaces: (probability, position, sigma)."""
    found = tuple(TargetSurface(p, np.asarray(x, float), np.eye(3) * s**2) for p, x, s in surfaces)
    return TargetSighting("t", found, (0.0, 0.0), round(k / rate_hz * 1e9))


def _edge(k: int, rng, roof: float) -> TargetSighting:
    noise = rng.normal(0, 0.2, (2, 3))
    return _sighting(k, (roof, ROOF + noise[0], 0.35), (1 - roof, GROUND + noise[1], 0.35))


def test_it_follows_a_moving_target_and_survives_an_outlier():
    rng = np.random.default_rng(3)
    target, velocity = TargetFilter(), np.array([6.0, -2.0, 0.0])
    for k in range(60):
        truth = velocity * k * 0.2
        noise = rng.normal(0, 1.0, 3) + (30.0 if k == 40 else 0.0)
        fix = target.update(_sighting(k, (1.0, truth + noise, 1.0)))
    assert np.linalg.norm(fix.position_world - truth) < 1.5
    np.testing.assert_allclose(target.velocity, velocity, atol=1.0)
    assert fix.elsewhere == 0.0


def test_what_was_seen_once_has_no_velocity():
    target = TargetFilter()
    assert target.velocity is None
    target.update(_sighting(0, (1.0, GROUND, 0.3)))
    assert target.velocity is None
    target.update(_sighting(1, (1.0, GROUND, 0.3)))
    assert target.velocity is not None
    assert np.linalg.norm(target.velocity) < 0.1
    for k in range(2, 5):  # elsewhere: the third time it begins anew
        target.update(_sighting(k, (1.0, ROOF + 200.0, 0.3)))
    assert target.velocity is None


def test_it_restarts_on_a_target_that_really_moved():
    target = TargetFilter()
    for k in range(20):
        position = np.zeros(3) if k < 10 else np.array([200.0, 0.0, 0.0])
        fix = target.update(_sighting(k, (1.0, position, 0.3)))
    np.testing.assert_allclose(fix.position_world, [200.0, 0.0, 0.0], atol=1.0)


def test_what_was_seen_on_the_ground_stays_there_when_an_edge_comes_near():
    rng = np.random.default_rng(0)
    target = TargetFilter()
    for k in range(20):
        target.update(_sighting(k, (1.0, GROUND + rng.normal(0, 0.2, 3), 0.35)))
    # Out of the picture for 6 s, then beside a roof that most of the bundle meets.
    for k in range(50, 70):
        fix = target.update(_edge(k, rng, roof=0.7))
        assert np.linalg.norm(fix.position_world) < 0.8
    assert fix.elsewhere < 0.5


def test_two_surfaces_are_reported_as_one_with_the_spread_of_both():
    rng = np.random.default_rng(1)
    target = TargetFilter()
    for k in range(20):
        fix = target.update(_edge(k, rng, roof=0.6))
        off = [float(np.linalg.norm(fix.position_world - x)) for x in (ROOF, GROUND)]
        assert min(off) < 1.0
        # The other surface is 4.8 m away and has 0.4: 3 m in the mean square.
        assert 2.0 < np.sqrt(fix.covariance.trace()) < 4.5
        assert fix.elsewhere == pytest.approx(0.4, abs=0.15)


def test_a_view_that_shows_one_surface_decides():
    rng = np.random.default_rng(2)
    for seen in (ROOF, GROUND):
        target = TargetFilter()
        for k in range(10):
            target.update(_edge(k, rng, roof=0.5))
        for k in range(10, 14):
            fix = target.update(_sighting(k, (1.0, seen + rng.normal(0, 0.2, 3), 0.35)))
        np.testing.assert_allclose(fix.position_world, seen, atol=0.6)
        assert fix.elsewhere == 0.0
        assert np.sqrt(fix.covariance.trace()) < 1.0


def test_a_gap_widens_the_fix_by_time_however_it_is_cut():
    def after(steps):
        target = TargetFilter()
        for k in range(11):
            target.update(_sighting(k, (1.0, np.zeros(3), 0.3)))
        for time_s in steps:  # so vague that they tell nothing
            fix = target.update(_sighting(time_s * 5, (1.0, np.zeros(3), 1e4)))
        return np.sqrt(fix.covariance.diagonal())

    once, often = after([8.0]), after([3.0, 4.0, 5.5, 8.0])
    np.testing.assert_allclose(once, often, rtol=1e-3)
    assert 2.0 < once[0] < 10.0
    assert once[2] < 2.0  # ground targets do not take off
