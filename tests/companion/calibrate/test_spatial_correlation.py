"""Pictures of the same ground err alike: a hundred of ten places are no hundred."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.calibrate.spatial_correlation import ImageNormalEquations, images_covariance
from localizer.geometry.pose import Array

PICTURES, PLACES = 240, 24


def larger(pulls: Array, grounds: Array) -> float:
    """Of one number that each picture tells with information 1, whatever its pose."""
    K = len(pulls)
    normals = ImageNormalEquations(
        np.tile(np.eye(6), (K, 1, 1)), np.zeros((K, 6, 1)), np.ones((K, 1, 1)), np.zeros((K, 6)),
        pulls[:, None],
    )  # fmt: skip
    gain = np.zeros((1, 1 + 6 * K))
    gain[0, 0] = 1.0 / K
    alone, factor = images_covariance(gain, 1, normals, grounds)
    assert alone[0, 0] == pytest.approx(1.0 / K)
    return float(factor[0])


def places(rng: np.random.Generator) -> tuple[NDArray[np.intp], Array]:
    """Each picture's place, and what it shows, m: ten of each place, legs apart in time."""
    of: NDArray[np.intp] = np.arange(PICTURES) % PLACES
    middles = np.stack([300.0 * (np.arange(PLACES) % 5), 300.0 * (np.arange(PLACES) // 5)], axis=1)
    return of, middles[of] + rng.uniform(-5.0, 5.0, (PICTURES, 2))


def test_pictures_that_err_for_themselves_are_believed():
    rng = np.random.default_rng(1)
    _, grounds = places(rng)
    pulls = rng.normal(0.0, 1.0, PICTURES)
    assert larger(pulls - pulls.mean(), grounds) < 1.35


def test_those_of_the_same_ground_that_err_alike_count_once_whenever_they_were_taken():
    rng = np.random.default_rng(2)
    of, grounds = places(rng)
    pulls = rng.normal(0.0, 1.0, PLACES)[of]
    factor = larger(pulls - pulls.mean(), grounds)
    assert factor == pytest.approx(np.sqrt(PICTURES / PLACES), rel=0.35)
