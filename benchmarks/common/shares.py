"""Intervals of shares."""

from __future__ import annotations

from typing import Literal

from scipy.stats import binomtest


def exact_interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper and Pearson), in per cent."""
    return _interval(hits, count, "exact")


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson), in per cent."""
    return _interval(hits, count, "wilson")


def _interval(hits: int, count: int, method: Literal["exact", "wilson"]) -> tuple[float, float]:
    if count == 0:
        return 0.0, 100.0
    found = binomtest(hits, count).proportion_ci(0.95, method)
    return 100 * float(found.low), 100 * float(found.high)
