"""How well forecasts told failures apart and how good their sigma was, with intervals over legs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import rankdata, spearmanr

from benchmarks.planning.legs import FORECASTS, PICTURES
from benchmarks.planning.run import FlownLeg, RegisteredFrame
from localizer.forecast.forecast import (
    RIGHT_M,
    RISK_LIMIT,
    WEIGHTS,
    Figures,
    expected_sigma_m,
    failure_risk,
    predictors,
)
from localizer.geometry.pose import Array

FAILED_SHARE = 0.2  # of a leg's pictures, refused or more than 1 m off: beyond it the leg failed
_BOOTSTRAPS = 400
COLUMNS = (
    "legs", "number", "failed, told", "good, called bad", "AUC", "error / sigma, by the median",
    "by the root mean square", "rank correlation",
)  # fmt: skip
_RIDGE = 0.005
# A figure that is better must not tell of more risk: signs of the weights of `predictors`.
_SIGNS = ((0, None), (None, 0), (None, 0), (None, 0), (0, None), (0, None))
_STUDENT = 4.0  # degrees of freedom
_CHI2_MEDIAN = 0.789  # of a third of chi-square with three degrees of freedom


def failed(picture: RegisteredFrame) -> bool:
    """Refused, or more than 1 m off."""
    return not picture.accepted or picture.error_m > RIGHT_M


def is_bad(leg: FlownLeg) -> bool:
    """Whether the leg did fail."""
    return float(np.mean([failed(p) for p in leg.pictures])) > FAILED_SHARE


def auc(score: Array, bad: NDArray[np.bool_]) -> float:
    """Area under the ROC curve: probability that a bad leg scores above a good one."""
    positives, negatives = int(bad.sum()), int((~bad).sum())
    if not positives or not negatives:
        return float("nan")
    ranks = rankdata(score)
    return float((ranks[bad].sum() - positives * (positives + 1) / 2) / (positives * negatives))


@dataclass(frozen=True)
class Scored:
    """A leg as its figures count it. risk: forecast; bad: whether it failed; squares: of errors
    over forecast variances of accepted pictures where vision is said to do; sigma_m, error_m: mean
    of the leg's forecast sigmas and rms of its errors there, NaN where none is.
    """

    risk: float
    bad: bool
    squares: Array
    sigma_m: float
    error_m: float

    @classmethod
    def of(
        cls, leg: FlownLeg, sigma: tuple[float, float], weights: Sequence[float] = WEIGHTS
    ) -> Scored:
        """Under the constants of sigma and the weights of the risk."""
        told = [failure_risk(f, weights) for f in leg.figures]
        each = PICTURES // FORECASTS
        kept = [
            (expected_sigma_m(leg.figures[k // each], sigma), p.error_m)
            for k, p in enumerate(leg.pictures)
            if p.accepted and told[k // each] <= RISK_LIMIT
        ]
        told_m, error = np.array(kept).reshape(-1, 2).T
        some = len(kept) > 0
        return cls(
            float(np.mean(told)),
            is_bad(leg),
            error**2 / 3 / told_m**2,
            float(told_m.mean()) if some else np.nan,
            float(np.sqrt((error**2).mean())) if some else np.nan,
        )


def interval(legs: Sequence[Scored], figure: Callable[[Sequence[Scored]], float]) -> list[float]:
    """The figure with its 95 % bootstrap interval over legs: [value, low, high]."""
    rng = np.random.default_rng(0)
    drawn = [
        figure([legs[int(i)] for i in rng.integers(0, len(legs), len(legs))])
        for _ in range(_BOOTSTRAPS)
    ]
    known = [x for x in drawn if np.isfinite(x)]
    low, high = np.percentile(known, (2.5, 97.5)) if known else (np.nan, np.nan)
    return [float(figure(legs)), float(low), float(high)]


def area(legs: Sequence[Scored]) -> float:
    """AUC of the forecast risk."""
    return auc(np.array([x.risk for x in legs]), np.array([x.bad for x in legs]))


def paired(leg: FlownLeg) -> list[tuple[Figures, RegisteredFrame]]:
    """Each picture with the forecast nearest to it."""
    each = PICTURES // FORECASTS
    return [(leg.figures[k // each], p) for k, p in enumerate(leg.pictures)]


def sigma_ratio(legs: Sequence[Scored]) -> float:
    """Measured error over forecast sigma, by the median of its square; 1 is calibrated."""
    squares = np.concatenate([x.squares for x in legs])
    return float(np.sqrt(np.median(squares) / _CHI2_MEDIAN)) if len(squares) else float("nan")


def sigma_ratio_rms(legs: Sequence[Scored]) -> float:
    """The same by the mean of its square: a few large errors count for much."""
    squares = np.concatenate([x.squares for x in legs])
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")


def rank_correlation(legs: Sequence[Scored]) -> float:
    """Spearman, of a leg's forecast sigma and its rms error, where vision is said to do."""
    pairs = np.array([(x.sigma_m, x.error_m) for x in legs if np.isfinite(x.sigma_m)])
    if len(pairs) < 3 or np.ptp(pairs, axis=0).min() == 0:
        return float("nan")
    return float(spearmanr(*pairs.T).statistic)


def summary(
    legs: Sequence[FlownLeg], sigma: tuple[float, float], threshold: float
) -> dict[str, Any]:
    """All figures of some legs."""
    scored = [Scored.of(leg, sigma) for leg in legs]
    bad, risk = np.array([x.bad for x in scored]), np.array([x.risk for x in scored])
    told = risk > threshold
    return {
        "legs": len(legs),
        "failed": int(bad.sum()),
        "auc": interval(scored, area),
        "told_of_failed": f"{int((told & bad).sum())} of {int(bad.sum())}",
        "false_alarms": f"{int((told & ~bad).sum())} of {int((~bad).sum())}",
        "sigma_ratio_median": interval(scored, sigma_ratio),
        "sigma_ratio_rms": interval(scored, sigma_ratio_rms),
        "rank_correlation": interval(scored, rank_correlation),
    }  # fmt: skip


def rows_of(parts: dict[str, dict[str, Any]]) -> list[tuple[str, ...]]:
    """Cells under `COLUMNS`, a row a part of the legs."""
    return [
        (
            name, str(part["legs"]), part["told_of_failed"], part["false_alarms"],
            *(
                "{:.2f} [{:.2f}, {:.2f}]".format(*part[key])
                for key in ("auc", "sigma_ratio_median", "sigma_ratio_rms", "rank_correlation")
            ),
        )
        for name, part in parts.items()
    ]  # fmt: skip


def fitted(legs: Sequence[FlownLeg]) -> dict[str, Any]:
    """`SIGMA` and `WEIGHTS` of these legs: ridge-regularized logistic regression; errors of
    Student's distribution with four degrees of freedom.
    """
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
    return {
        "SIGMA": _spread(pairs, weights),
        "WEIGHTS": weights,
    }


def _spread(
    pairs: Sequence[tuple[Figures, RegisteredFrame]], weights: Sequence[float]
) -> list[float]:
    """`SIGMA`: likeliest for what is accepted where vision is said to do, then scaled until half of
    the errors are below their median.
    """
    kept = [
        (f.sigma_m, p.error_m) for f, p in pairs
        if p.accepted and failure_risk(f, weights) <= RISK_LIMIT
    ]  # fmt: skip
    simulated, error = np.array(kept).T

    def loss(logs: Array) -> float:
        sigma = np.hypot(*np.exp(logs)[:, None] * [simulated, np.ones(len(simulated))])
        tails = (_STUDENT + 3) / 2 * np.log1p((error / sigma) ** 2 / _STUDENT)
        return float((3 * np.log(sigma) + tails).mean())

    found = np.exp(minimize(loss, np.log([0.8, 0.1]), method="Nelder-Mead").x)
    sigma = np.hypot(found[0] * simulated, found[1])
    scale = float(np.sqrt(np.median(error**2 / 3 / sigma**2) / _CHI2_MEDIAN))
    return [round(float(scale * x), 3) for x in found]
