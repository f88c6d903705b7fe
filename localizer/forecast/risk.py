"""Converts simulated registrations to a forecast for real flights, by a fitted model.

`SIGMA` and `WEIGHTS` come from ``python -m benchmarks.planning FOLDER --fit`` on its tuning worlds:
276 legs over seven, and 60 legs over three of them. Its held-out worlds were not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array

RIGHT_M = 1.0  # beyond it a position is not "right"
WORST_M = 10.0  # sigmas and errors beyond it count as this
RISK_LIMIT = 0.2  # share of pictures lost or wrong beyond which a place will not do

SIGMA = (0.705, 0.097)
"""Position error in flight, one axis: a factor of the simulated registration's sigma, and what the
ground itself adds, m, see `expected_sigma_m`."""

WEIGHTS = (1.431, 0.578, -0.631, 0.0, -2.07, 0.284, 0.211)
"""Of the logistic model: constant, then those of `predictors`."""


@dataclass(frozen=True)
class Figures:
    """Statistics of simulated registrations at one view. sigma_m: median position sigma (one axis,
    rms), not yet scaled; agreement, quality: means; map_share: of the image; failed: share rejected
    or with an error above `RIGHT_M`; error_m: mean error, at most `WORST_M`.
    """

    sigma_m: float
    agreement: float
    quality: float
    map_share: float
    failed: float
    error_m: float


def predictors(figures: Figures) -> Array:
    """Inputs (6,) of the logistic model."""
    f = figures
    sigma, error = (np.log(np.clip(x, 0.01, WORST_M)) for x in (f.sigma_m, f.error_m))
    return np.array([sigma, f.agreement, f.quality, f.map_share, f.failed, error])


def expected_sigma_m(figures: Figures, constants: tuple[float, float] = SIGMA) -> float:
    """Expected position error of accepted registrations, one axis, m, from the images' equations
    and from errors of the map.
    """
    factor, map_m = constants
    return float(np.hypot(factor * figures.sigma_m, map_m))


def failure_risk(figures: Figures, weights: Sequence[float] = WEIGHTS) -> float:
    """Probability, 0 to 1, that a frame taken there is rejected or has an error above `RIGHT_M`."""
    constant, *slopes = weights
    return float(1.0 / (1.0 + np.exp(-(constant + np.dot(slopes, predictors(figures))))))
