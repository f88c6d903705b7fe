"""Where a standing target is by many viewpoints."""

import numpy as np
import pytest

from localizer.targets.locate import RaySpread
from localizer.targets.static import ObservedRay, StaticTarget, every_second
from localizer.types import TargetSurface

PLACE = np.zeros(3)
SURFACE = TargetSurface(1.0, PLACE, np.eye(3), np.array([0.0, 0.0, 1.0]), 0.1)


def _ray(turn_deg: float) -> ObservedRay:
    turn = np.radians(turn_deg)
    eye = np.array([100.0 * np.cos(turn), 100.0 * np.sin(turn), 80.0])
    direction = (PLACE - eye) / np.linalg.norm(PLACE - eye)
    sideways = np.linalg.svd(direction[None])[2][1:]
    return ObservedRay(eye, direction, RaySpread(sideways, 1e-5 * np.eye(2), 1e-6 * np.eye(2)))


def _covariance(turns_deg: list[float]) -> np.ndarray:
    target = StaticTarget(100.0)  # rays alone
    for turn in turns_deg:
        assert target.update(_ray(turn), (SURFACE,))
    return target.hypotheses()[0].covariance


def test_of_too_many_viewpoints_none_counts_twice():
    turns = [10.0 * k for k in range(33)]  # one more than are kept
    np.testing.assert_allclose(_covariance(turns), _covariance(turns[::2]), rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("count", [2, 3, 32, 33])
def test_the_first_and_the_newest_are_kept(count):
    kept = every_second(list(range(count)))
    assert (kept[0], kept[-1]) == (0, count - 1)
    assert sorted(set(kept)) == kept
