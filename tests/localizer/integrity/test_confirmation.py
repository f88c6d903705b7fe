"""What confirms a place that was found by searching: a way that was flown, and no noise."""

from __future__ import annotations

import numpy as np
import pytest

from localizer.geometry.pose import Pose
from localizer.integrity.acceptance import IntegrityConfig
from localizer.integrity.confirmation import (
    Consistency,
    IndependentEvidence,
    TentativeTrack,
    consistency_test,
)

CONFIG = IntegrityConfig()
BEGUN = Pose(np.eye(3), np.array([0.0, 0.0, 100.0]))


def weighed(east_m: float, sigmas_m: tuple[float, float]) -> Consistency:
    """0.2 s after the first acceptance, of estimates with these sigmas, east and north."""
    covariance = np.diag([sigmas_m[0] ** 2, sigmas_m[1] ** 2, 0.01, 1e-4, 1e-4, 1e-4])
    pose = Pose(np.eye(3), np.array([east_m, 0.0, 100.0]))
    tentative_track = TentativeTrack(BEGUN, covariance, 0)
    return consistency_test(
        tentative_track, pose, covariance, 200_000_000, IndependentEvidence(), CONFIG
    )


@pytest.mark.parametrize("east_m", [5.5, -9.0])
def test_estimates_that_slide_along_what_looks_alike_have_flown_no_way(east_m: float) -> None:
    """A row of crops, a street: each fits 3 m beside the one before, and says so. Two of them 5 m
    apart, the same view, were taken for a way over which the map goes on to match.
    """
    assert weighed(east_m, (3.0, 0.1)) is Consistency.PENDING


def test_a_way_that_is_known_confirms_however_unsure_the_other_axis_is() -> None:
    assert weighed(6.0, (0.1, 3.0)) is Consistency.CONFIRMED
    assert weighed(6.0, (0.15, 0.15)) is Consistency.CONFIRMED
    assert weighed(18.0, (3.0, 0.1)) is Consistency.CONFIRMED  # farther than they slide
