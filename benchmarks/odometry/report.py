"""What the steps say: drift, honesty of the covariance, and the growth that fits them."""

from __future__ import annotations

import itertools

import numpy as np

from benchmarks.odometry.flights import FlownStretch, OdometryStep
from localizer.geometry.pose import Array

_CHI2_95 = 5.991
_LEAST_WAY_M = 50.0  # before it, per cent of the way mean nothing
_GRID = np.geomspace(1e-4, 0.3, 28)


def rows(flown: list[FlownStretch]) -> list[dict[str, object]]:
    """One line for each place, source of depth and condition, and for all conditions."""
    found = []
    for place, depth in sorted({(f.place, f.depth) for f in flown}):
        mine = [f for f in flown if (f.place, f.depth) == (place, depth)]
        for condition in (*sorted({f.condition for f in mine}), "all"):
            chosen = [f for f in mine if condition in (f.condition, "all")]
            found.append({"place": place, "depth": depth, "condition": condition, **_row(chosen)})
    return found


def _row(flown: list[FlownStretch]) -> dict[str, object]:
    ends = [f.steps[-1] for f in flown]
    metres = np.array([_horizontal(s) for s in ends])
    share = 100 * metres / np.array([s.flown_m for s in ends])
    worst = [max(100 * _horizontal(s) / s.flown_m for s in _counted(f)) for f in flown]
    inside = [np.mean([_inside(s) for s in f.steps if s.status == "OK"]) for f in flown]
    usable = [np.mean([s.status == "OK" for s in f.steps]) for f in flown]
    return {
        "stretches": len(flown),
        "way_m": float(np.median([s.flown_m for s in ends])),
        "end_m_p50": float(np.quantile(metres, 0.5)),
        "end_m_p95": float(np.quantile(metres, 0.95)),
        "end_percent_p50": float(np.quantile(share, 0.5)),
        "end_percent_p95": float(np.quantile(share, 0.95)),
        "worst_percent": float(np.max(worst)),
        "height_m_p95": float(np.quantile([abs(s.error[2]) for s in ends], 0.95)),
        "inside_95_percent": float(100 * np.mean(inside)),
        "inside_95_at_end": f"{sum(_inside(s) for s in ends)}/{len(ends)}",
        "told_m_p50": float(np.median([s.drift_m for s in ends])),
        "usable_percent": float(100 * np.mean(usable)),
        "carried_to_the_end": sum(s.status == "OK" for s in ends),
        "step_ms_p50": float(np.median([s.ms for f in flown for s in f.steps])),
    }


def _counted(flown: FlownStretch) -> list[OdometryStep]:
    return [s for s in flown.steps if s.flown_m >= _LEAST_WAY_M] or [flown.steps[-1]]


def _horizontal(step: OdometryStep) -> float:
    return float(np.hypot(step.error[0], step.error[1]))


def _inside(step: OdometryStep) -> bool:
    return _distance(np.array(step.error[:2]), np.array(step.covariance)[:2, :2]) <= _CHI2_95


def _distance(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def fitted_growth(flown: list[FlownStretch]) -> dict[str, float]:
    """Scale and horizontal walk of greatest likelihood, for steps flown without any growth.

    Each stretch counts as one draw: errors of neighbouring steps are the same error.
    """
    steps = [s for f in flown for s in _counted(f) if s.status == "OK"]
    weight = len(flown) / max(len(steps), 1)
    error = np.array([s.error[:2] for s in steps])
    base = np.array([s.covariance for s in steps])[:, :2, :2]
    way = np.array([s.displacement[:2] for s in steps])
    along = way[:, :, None] * way[:, None, :]
    flown_m = np.array([s.flown_m for s in steps])[:, None, None] * np.eye(2)
    best: tuple[float, float, float] = (np.inf, 0.0, 0.0)
    for scale, walk in itertools.product(_GRID, _GRID):
        P = base + scale**2 * along + walk**2 * flown_m
        cost = np.log(np.linalg.det(P)) + np.einsum(
            "ki,ki->k", error, np.linalg.solve(P, error[:, :, None])[:, :, 0]
        )
        best = min(best, (weight * float(cost.sum()), float(scale), float(walk)))
    return {"scale": best[1], "horizontal": best[2]}
