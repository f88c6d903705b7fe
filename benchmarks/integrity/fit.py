"""The probability of `localizer.integrity.probability` from labelled registrations.

A registration is right where its patches lie on their true ground, wrong where they lie twice as
far off as that allows or on another map; what lies between teaches nothing. Every set has the same
weight, its right and its wrong ones, too. Each set is judged by a fit that has seen no set of its
kind. The file that ships is fitted to all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize

from benchmarks.integrity.maps import TUNING, UNSEEN
from benchmarks.integrity.run import StartOutcome
from benchmarks.real.sets import describe
from localizer.geometry.pose import Array
from localizer.integrity.acceptance import IntegrityConfig
from localizer.integrity.probability import FEATURES, PlaceModel, evidence

_RIGHT_M = 3.0
_OTHER_DATE = ("fengyuan", "neon")  # whose truth or alignment is less exact
_KIND = {TUNING: "generated", UNSEEN: "generated", "outdated": "portugal"}
_LEFT_OUT = ("shifted",)  # its picture and its heights show two places
_LEAST_COUNT = 20  # a set with a single right one teaches that one no better
_RIDGE = 1e-3


class Labelled:
    """The outcomes of one set. features: (N, 4); right: (N,) 1 or 0."""

    def __init__(self, name: str, outcomes: Sequence[StartOutcome]) -> None:
        self.kind = _KIND.get(name, name)
        limit = describe(name).right_m if name in _OTHER_DATE else _RIGHT_M
        known = [
            o for o in outcomes
            if o.ok and o.parts and not limit < o.ground_m <= 2 * limit
            and not o.kind.startswith("focal")
        ]  # fmt: skip
        self.features = np.array([_features(o) for o in known]).reshape(-1, len(FEATURES))
        self.right = np.array([o.ground_m <= limit for o in known], np.float64)

    @property
    def weights(self) -> Array:
        """(N,) one for the right ones together, and one for the wrong ones."""
        counts = [max(float((self.right == k).sum()), _LEAST_COUNT) for k in (0, 1)]
        return 1.0 / np.take(counts, self.right.astype(int))


def _features(outcome: StartOutcome) -> Array:
    o = outcome
    return evidence(o.quality, o.parts, o.votes / o.parts, o.peak, o.lead)


def fitted_model(sets: Sequence[Labelled]) -> PlaceModel:
    """Logistic regression with a small ridge."""
    x = np.concatenate([s.features for s in sets])
    y, weight = (np.concatenate([getattr(s, key) for s in sets]) for key in ("right", "weights"))
    mean, spread = x.mean(axis=0), x.std(axis=0)
    z = np.column_stack([(x - mean) / spread, np.ones(len(x))])
    share = weight / weight.sum()

    def loss(b: Array) -> tuple[float, Array]:
        odds = z @ b
        missed = np.logaddexp(0.0, np.where(y == 1, -odds, odds))
        slope = z.T @ (share * (1.0 / (1.0 + np.exp(-odds)) - y))
        ridge = np.append(b[:-1], 0.0)
        return float(share @ missed + _RIDGE * ridge @ ridge), slope + 2 * _RIDGE * ridge

    b = minimize(loss, np.zeros(z.shape[1]), jac=True).x
    return PlaceModel(mean, spread, b[:-1], float(b[-1]))


def fit(outcomes: Sequence[StartOutcome]) -> dict[str, Any]:
    """The content of probability.json."""
    names = [n for n in dict.fromkeys(o.set for o in outcomes) if n not in _LEFT_OUT]
    sets = {n: Labelled(n, [o for o in outcomes if o.set == n]) for n in names}
    model = fitted_model(list(sets.values()))
    columns = zip(FEATURES, model.mean, model.spread, model.weights, strict=True)
    return {
        "made_by": "python -m benchmarks.integrity FOLDER --fit FILE",
        "features": {
            name: {"mean": round(m, 4), "spread": round(s, 4), "weight": round(w, 4)}
            for name, m, s, w in columns
        },
        "bias": round(model.bias, 4),
        "fitted_on": {
            n: {"right": int(s.right.sum()), "wrong": int((1 - s.right).sum())}
            for n, s in sets.items()
        },
        "left_out": {n: _judged_without(n, sets) for n in names},
    }  # fmt: skip


def _judged_without(name: str, sets: Mapping[str, Labelled]) -> dict[str, float]:
    """A set by a fit without its kind."""
    own = sets[name]
    model = fitted_model([s for s in sets.values() if s.kind != own.kind])
    odds = np.array([model.log_odds(f) for f in own.features])
    limit, right, wrong = IntegrityConfig().min_log_odds, odds[own.right == 1], odds[own.right == 0]
    return {
        "limit": limit,
        "right_accepted": round(float((right >= limit).mean()), 3) if len(right) else 0.0,
        "wrong_accepted": int((wrong >= limit).sum()),
        "largest_wrong": round(float(wrong.max()), 2) if len(wrong) else 0.0,
    }


def fit_table(fitted: Mapping[str, Any]) -> str:
    """Each set by the fit without its kind. No set's wide priors ask for more evidence here."""
    lines = [
        "| set | right | wrong | right accepted | wrong accepted | largest wrong log odds |",
        "|---|---|---|---|---|---|",
    ]
    for name, counts in fitted["fitted_on"].items():
        j = fitted["left_out"][name]
        lines.append(
            f"| {name} | {counts['right']} | {counts['wrong']} | {100 * j['right_accepted']:.0f} % "
            f"| {j['wrong_accepted']} | {j['largest_wrong']:.1f} |"
        )
    return "\n".join(lines)
