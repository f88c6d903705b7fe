"""Probability that a registration shows the right position.

A wrong position can look right in one respect: low residuals over uniform land, or a few patches
that match similar roofs. It seldom does in all. So a logistic regression over all evidence gives
the probability. It is fitted on labelled registrations of several maps with equal weights.
`probability.json` has its weights, data, and cross-validation results. ``python -m
benchmarks.integrity FOLDER --fit`` makes it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from localizer.errors import ModelError
from localizer.geometry.pose import Array
from localizer.registration.agreement import PatchAgreement
from localizer.registration.result import Registration
from localizer.types import RegistrationStatus

MODEL = Path(__file__).with_name("probability.json")
FEATURES = ("log_quality", "inlier_excess", "peak", "patch_peak", "log_lead")
_CHANCE = 0.1  # of the patches that match where they lie, at wrong places
_LEAST_QUALITY, _LEAST_LEAD = 0.02, 0.003  # below, a logarithm says no more


@dataclass(frozen=True)
class PlaceModel:
    """Logistic regression of whether a registration is at the right position. Log odds = bias + sum
    of weights times (feature - mean) / spread; arrays are (5,), in the order of `FEATURES`. A
    feature that is infinite has no weight.
    """

    mean: Array
    spread: Array
    weights: Array
    bias: float

    def log_odds(self, features: Array) -> float:
        """Natural log odds of the right position, for equal prior probabilities."""
        known = np.where(np.isposinf(features), self.mean, features)
        return float(self.bias + self.weights @ ((known - self.mean) / self.spread))


@cache
def place_model(path: Path = MODEL) -> PlaceModel:
    """The fitted model in the JSON file at `path`. Each file is read once, on the first call.
    `ModelError` if it is damaged.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        columns = [data["features"][name] for name in FEATURES]
        mean, spread, weights = (
            np.array([column[key] for column in columns], float)
            for key in ("mean", "spread", "weight")
        )
        return PlaceModel(mean, spread, weights, float(data["bias"]))
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ModelError(f"{path}: damaged ({error!r}); install the program again") from error


def place_features(result: Registration) -> Array | None:
    """Evidence (5,) of a registration, in the order of `FEATURES`; None after a failure or without
    patches.

    The five values are: quality of the fit; number of patches that match at their own position,
    beyond chance, in sigmas; match of the whole image at its position against the matches beside
    it, in sigmas; the same of its best patches; lead over the best other mode of the swarm.
    """
    votes = result.agreement
    if result.status is not RegistrationStatus.OK or votes is None or votes.patches == 0:
        return None
    return evidence(result.quality, votes, result.lead)


def evidence(quality: float, votes: PatchAgreement, lead: float) -> Array:
    """Evidence (5,) from the values of a `Registration`. quality: 0 to 1; lead: relative cost
    margin over the second-best mode, inf without one. That is no evidence: a narrow prior leaves
    room for no other mode, at a wrong position as well.
    """
    return np.array(
        [
            np.log(max(quality, _LEAST_QUALITY)),
            np.sqrt(votes.patches) * (votes.share - _CHANCE),
            votes.peak,
            votes.patch_peak,
            np.inf if lead == np.inf else np.log(np.clip(lead, _LEAST_LEAD, 1.0)),
        ]
    )


def log_odds(result: Registration) -> float:
    """Natural log odds that a registration shows the right position; -inf without evidence.

    Of several passes over one image the least counts: a later pass searches a smaller space about
    the result before, so it finds no rival position, at a wrong one as well.
    """
    features = place_features(result)
    if features is None:
        return -np.inf
    return float(np.minimum(place_model().log_odds(features), result.earlier_log_odds))
