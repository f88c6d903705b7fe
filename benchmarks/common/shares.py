"""Intervals of shares."""

from __future__ import annotations

from scipy.stats import beta


def exact_interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper and Pearson), in per cent."""
    low = 0.0 if hits == 0 else float(beta.ppf(0.025, hits, count - hits + 1))
    high = 1.0 if hits == count else float(beta.ppf(0.975, hits + 1, count - hits))
    return 100 * low, 100 * high
