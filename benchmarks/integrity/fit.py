"""The probability of `localizer.integrity.probability` from labelled registrations.

A registration is right where its patches lie on their true ground, wrong where they lie twice as
far off as that allows or on another map; what lies between teaches nothing. Of the wrong ones, the
tenth of each set that looks most like a right one is fitted: any fit refuses the others, and they
would hide those. Every set has the same weight, and so have its right and its wrong ones.
"fengyuan" and the dark sets are kept back: fitted to those, quality would count for nothing. Each
set is also judged by a fit that has seen no set of its kind, with the other tests of acceptance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from benchmarks.integrity.maps import DARK, TUNING, UNSEEN
from benchmarks.integrity.run import StartOutcome
from benchmarks.real.sets import describe
from localizer.geometry.pose import Array
from localizer.integrity.acceptance import IntegrityConfig, ambiguity
from localizer.integrity.probability import FEATURES, PlaceModel

_RIGHT_M = 3.0
_OTHER_DATE = ("fengyuan", "neon")  # whose truth or alignment is less exact
_KIND = {TUNING: "generated", UNSEEN: "generated", "outdated": "portugal"}
_NO_LABELS = ("shifted",)  # its picture and its heights show two places
_KEPT_BACK = ("fengyuan",)
_LEAST_COUNT = 20  # a set with a single right one teaches that one no better
_RIDGE = 1e-3
_HARDEST = 0.1  # of the wrong ones


@dataclass(frozen=True)
class Labelled:
    """The outcomes of one kind of map. features: (N, 5); right: (N,) 1 or 0; asked: (N,) log odds
    by which the other tests of acceptance ask for more.
    """

    kind: str
    features: Array
    right: Array
    asked: Array

    @classmethod
    def of(cls, name: str, outcomes: Sequence[StartOutcome]) -> Labelled:
        """Those of a set whose label is sure."""
        name = name.removeprefix(DARK)
        limit = describe(name).right_m if name in _OTHER_DATE else _RIGHT_M
        known = [
            o for o in outcomes
            if o.ok and o.parts and not limit < o.ground_m <= 2 * limit
            and not o.kind.startswith("focal")
        ]  # fmt: skip
        features = np.array([o.evidence for o in known]).reshape(-1, len(FEATURES))
        right = np.array([o.ground_m <= limit for o in known], np.float64)
        return cls(_KIND.get(name, name), features, right, np.array([_asked(o) for o in known]))

    def hardest(self, model: PlaceModel) -> Labelled:
        """All right ones, and the wrong ones of the highest odds."""
        odds = self.log_odds(model)
        wrong = np.flatnonzero(self.right == 0)
        count = max(_LEAST_COUNT, round(_HARDEST * len(wrong)))
        chosen = np.sort(
            np.concatenate(
                [np.flatnonzero(self.right == 1), wrong[np.argsort(-odds[wrong])[:count]]]
            )
        )
        return replace(
            self, features=self.features[chosen], right=self.right[chosen], asked=self.asked[chosen]
        )

    def log_odds(self, model: PlaceModel) -> Array:
        """(N,) by a model."""
        return np.array([model.log_odds(f) for f in self.features])

    @property
    def weights(self) -> Array:
        """(N,) one for the right ones together, and one for the wrong ones."""
        counts = [max(float((self.right == k).sum()), _LEAST_COUNT) for k in (0, 1)]
        return 1.0 / np.take(counts, self.right.astype(int))


def _asked(outcome: StartOutcome) -> float:
    """By the width of the prior; infinite where another test refuses it. The distance from the
    prior is none of them: here it lacks the attitude and the map's error.
    """
    limits, o = IntegrityConfig(), outcome
    if o.overlap < limits.min_overlap or o.focal_gain > limits.max_focal_gain:
        return math.inf
    return ambiguity(limits, o.prior_sigma_m)


def fitted_model(sets: Sequence[Labelled]) -> PlaceModel:
    """Fitted to the right ones and to the hardest of the wrong ones."""
    first = _regression(sets)
    model = _regression([s.hardest(first) for s in sets])
    # Among all wrong ones, those that were fitted are so many times rarer.
    return replace(model, bias=model.bias - math.log(_HARDEST))


def _regression(sets: Sequence[Labelled]) -> PlaceModel:
    """Logistic regression with a small ridge."""
    x = np.concatenate([s.features for s in sets])
    x[np.isinf(x)] = np.nan
    y, weight = (np.concatenate([getattr(s, key) for s in sets]) for key in ("right", "weights"))
    mean, spread = np.nanmean(x, axis=0), np.nanstd(x, axis=0)
    z = np.column_stack([np.nan_to_num((x - mean) / spread), np.ones(len(x))])
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
    names = [n for n in dict.fromkeys(o.set for o in outcomes) if n not in _NO_LABELS]
    labelled = {n: Labelled.of(n, [o for o in outcomes if o.set == n]) for n in names}
    sets = {n: s for n, s in labelled.items() if n not in _KEPT_BACK and not n.startswith(DARK)}
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
        "left_out": {n: _judged_without(own, sets.values()) for n, own in labelled.items()},
    }  # fmt: skip


def _judged_without(own: Labelled, sets: Iterable[Labelled]) -> dict[str, float]:
    """A set by a fit without its kind. largest_wrong: what is asked for besides taken off."""
    odds = own.log_odds(fitted_model([s for s in sets if s.kind != own.kind])) - own.asked
    limit, right, wrong = IntegrityConfig().min_log_odds, odds[own.right == 1], odds[own.right == 0]
    return {
        "limit": limit,
        "right": len(right),
        "wrong": len(wrong),
        "right_accepted": round(float((right >= limit).mean()), 3) if len(right) else 0.0,
        "wrong_accepted": int((wrong >= limit).sum()),
        "largest_wrong": round(float(wrong.max()), 2) if len(wrong) else 0.0,
    }


def fit_table(fitted: Mapping[str, Any]) -> str:
    """Each set by the fit without its kind."""
    lines = [
        "| set, left out | right | wrong | right accepted | wrong accepted | largest wrong |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {name} | {j['right']} | {j['wrong']} | {100 * j['right_accepted']:.0f} % "
        f"| {j['wrong_accepted']} | {j['largest_wrong']:.1f} |"
        for name, j in fitted["left_out"].items()
    ]
    return "\n".join(lines)
