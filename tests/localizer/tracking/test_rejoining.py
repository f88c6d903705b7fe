"""The map's registrations against a carried pose that began wrong: when they win, and when not."""

import numpy as np
import pytest

from localizer.geometry.pose import Pose
from localizer.integrity.acceptance import IntegrityConfig
from localizer.tracking.rejoining import Rejoining

CONFIG = IntegrityConfig()
COVARIANCE = np.diag([0.15**2] * 3 + [0.002**2] * 3)
ASIDE = np.array([-2.6, 1.4, 0.3])  # of the carried pose, as after a slew that was not modelled


def _run(
    registrations: list[np.ndarray], carried: list[np.ndarray], rotation: np.ndarray | None = None
) -> list[bool]:
    said, run = [], Rejoining()
    for k, (answer, place) in enumerate(zip(registrations, carried, strict=True)):
        run = run.with_registration(
            Pose(np.eye(3), answer), COVARIANCE, k * 100_000_000, Pose(np.eye(3), place), rotation,
            CONFIG,
        )  # fmt: skip
        said.append(run.confirmed)
    return said


def _way(speed: float, count: int, noise_m: float = 0.1) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [
        np.array([0.1 * speed * k, 0.0, 100.0]) + rng.normal(0, noise_m, 3) for k in range(count)
    ]


def test_answers_that_move_as_the_odometry_does_win_within_a_second():
    true = _way(10.0, 14)
    said = _run(true, [p + ASIDE for p in _way(10.0, 14, 0.02)])
    assert not any(said[:7])
    assert said[10:] == [True] * 4


def test_a_match_that_moves_otherwise_never_wins():
    carried = _way(10.0, 40, 0.02)
    sliding = [p + ASIDE + np.array([0.0, -0.35 * k, 0.0]) for k, p in enumerate(carried)]
    scattered = [p + np.random.default_rng(k).normal(0, 3.0, 3) for k, p in enumerate(carried)]
    stuck = [carried[0] + ASIDE] * 40
    for registrations in (sliding, scattered, stuck):
        assert not any(_run(registrations, carried))


@pytest.mark.parametrize(("rotation", "wins"), [(None, False), (np.eye(3), True)])
def test_a_hover_shows_nothing_new_without_the_autopilots_attitude(rotation, wins):
    registrations = _way(0.0, 40, 0.05)
    assert any(_run(registrations, [p + ASIDE for p in registrations], rotation)) is wins


def test_an_attitude_that_the_autopilot_refutes_never_wins():
    registrations = _way(10.0, 20)
    tilted = np.array([[1.0, 0, 0], [0, 0.94, -0.34], [0, 0.34, 0.94]])
    assert not any(_run(registrations, [p + ASIDE for p in registrations], tilted))
