"""How well forecasts told failures apart and how good their sigma was, with intervals over legs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import rankdata, spearmanr

from benchmarks.planning.legs import FORECASTS, PICTURES
from benchmarks.planning.run import Flown, Picture
from localizer.forecast.risk import RIGHT_M, RISK_LIMIT, WEIGHTS, Figures, failure_risk, predictors
from localizer.geometry.pose import Array

FAILED_SHARE = 0.2  # of a leg's pictures, refused or more than 1 m off: beyond it the leg failed
_BOOTSTRAPS = 2000
_RIDGE = 0.005
# A figure that is better must not tell of more risk: signs of the weights of `predictors`.
_SIGNS = ((0, None), (None, 0), (None, 0), (None, 0), (0, None), (0, None))
_CHI2_MEDIAN = 0.789  # of a third of chi-square with three degrees of freedom


def failed(picture: Picture) -> bool:
    """Refused, or more than 1 m off."""
    return not picture.accepted or picture.error_m > RIGHT_M


def is_bad(leg: Flown) -> bool:
    """Whether the leg did fail."""
    return float(np.mean([failed(p) for p in leg.pictures])) > FAILED_SHARE


def leg_risk(leg: Flown) -> float:
    """As forecast, mean along the leg."""
    return float(np.mean([failure_risk(f) for f in leg.figures]))


def auc(score: Array, bad: NDArray[np.bool_]) -> float:
    """Area under the ROC curve: probability that a bad leg scores above a good one."""
    positives, negatives = int(bad.sum()), int((~bad).sum())
    if not positives or not negatives:
        return float("nan")
    ranks = rankdata(score)
    return float((ranks[bad].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def interval(legs: Sequence[Flown], figure: Callable[[Sequence[Flown]], float]) -> list[float]:
    """The figure with its 95 % bootstrap interval over legs: [value, low, high]."""
    rng = np.random.default_rng(0)
    drawn = [
        figure([legs[int(i)] for i in rng.integers(0, len(legs), len(legs))])
        for _ in range(_BOOTSTRAPS)
    ]
    low, high = np.nanpercentile(drawn, (2.5, 97.5))
    return [float(figure(legs)), float(low), float(high)]


def paired(leg: Flown) -> list[tuple[Figures, Picture]]:
    """Each picture with the forecast nearest to it."""
    each = PICTURES // FORECASTS
    return [(leg.figures[k // each], p) for k, p in enumerate(leg.pictures)]


def sigma_ratio(legs: Sequence[Flown], factor: float, weights: Sequence[float] = WEIGHTS) -> float:
    """Measured error over forecast sigma, by the median of its square; 1 is calibrated."""
    squares = _squared_ratios(legs, factor, weights)
    return float(np.sqrt(np.median(squares) / _CHI2_MEDIAN)) if len(squares) else float("nan")


def sigma_ratio_rms(legs: Sequence[Flown], factor: float) -> float:
    """The same by the mean of its square: a few large errors count for much."""
    squares = _squared_ratios(legs, factor, WEIGHTS)
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")


def _squared_ratios(legs: Sequence[Flown], factor: float, weights: Sequence[float]) -> Array:
    """Of accepted pictures where the forecast says that vision will do, as a user is told sigma."""
    return np.array(
        [
            p.error_m**2 / 3 / (factor * f.sigma_m) ** 2
            for leg in legs
            for f, p in paired(leg)
            if p.accepted and failure_risk(f, weights) <= RISK_LIMIT
        ]
    )


def rank_correlation(legs: Sequence[Flown]) -> float:
    """Spearman, of a leg's forecast sigma and its rms error, on legs that would be flown."""
    sigma, error = [], []
    for leg in legs:
        kept = [(f.sigma_m, p.error_m) for f, p in paired(leg) if p.accepted]
        if kept and leg_risk(leg) <= RISK_LIMIT:
            sigma.append(np.mean([s for s, _ in kept]))
            error.append(np.sqrt(np.mean([e**2 for _, e in kept])))
    return float(spearmanr(sigma, error).statistic) if len(sigma) > 2 else float("nan")


def summary(legs: Sequence[Flown], factor: float, threshold: float) -> dict[str, Any]:
    """All figures of some legs."""
    bad = np.array([is_bad(leg) for leg in legs])
    risk = np.array([leg_risk(leg) for leg in legs])
    told = risk > threshold

    def area(some: Sequence[Flown]) -> float:
        return auc(np.array([leg_risk(x) for x in some]), np.array([is_bad(x) for x in some]))

    return {
        "legs": len(legs),
        "failed": int(bad.sum()),
        "auc": interval(legs, area),
        "told_of_failed": f"{int((told & bad).sum())} of {int(bad.sum())}",
        "false_alarms": f"{int((told & ~bad).sum())} of {int((~bad).sum())}",
        "brier": float(np.mean((risk - [np.mean([failed(p) for p in x.pictures]) for x in legs])
                               ** 2)),
        "sigma_ratio_median": interval(legs, lambda s: sigma_ratio(s, factor)),
        "sigma_ratio_rms": interval(legs, lambda s: sigma_ratio_rms(s, factor)),
        "rank_correlation": interval(legs, rank_correlation),
        "risk_table": _reliability(risk, legs),
    }  # fmt: skip


def _reliability(risk: Array, legs: Sequence[Flown]) -> list[dict[str, Any]]:
    """Forecast risk against the share of pictures that failed, by bins of risk."""
    shares = np.array([np.mean([failed(p) for p in leg.pictures]) for leg in legs])
    edges = (0.0, 0.05, 0.2, 0.5, 0.8, 1.0001)
    rows = []
    for low, high in itertools.pairwise(edges):
        inside = (risk >= low) & (risk < high)
        if inside.any():
            rows.append(
                {
                    "risk": f"{low:g} to {min(high, 1):g}",
                    "legs": int(inside.sum()),
                    "forecast": float(risk[inside].mean()),
                    "failed": float(shares[inside].mean()),
                }
            )
    return rows


def fitted(legs: Sequence[Flown]) -> dict[str, Any]:
    """`SIGMA_FACTOR` and `WEIGHTS` of these legs: ridge-regularized logistic regression."""
    pairs = [pair for leg in legs for pair in paired(leg)]
    x = np.stack([predictors(f) for f, _ in pairs])
    y = np.array([failed(p) for _, p in pairs], float)
    mean, spread = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-6)
    z = np.column_stack([np.ones(len(x)), (x - mean) / spread])

    def loss(weights: Array) -> float:
        logits = z @ weights
        fit = np.logaddexp(0.0, logits) - y * logits
        return float(fit.mean() + _RIDGE * (weights[1:] ** 2).sum())

    bounds = [(None, None), *_SIGNS]
    found = minimize(loss, np.zeros(len(WEIGHTS)), method="L-BFGS-B", bounds=bounds).x
    slopes = found[1:] / spread
    constant = float(found[0] - slopes @ mean)
    weights = [round(float(w), 3) for w in (constant, *slopes)]
    return {"SIGMA_FACTOR": sigma_ratio(legs, 1.0, weights), "WEIGHTS": weights}
