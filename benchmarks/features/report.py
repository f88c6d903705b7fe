"""Outcomes of the feature benchmark as CSV, and their confidence intervals."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from localizer.errors import SequenceError

_DRAWS = 2000  # of the bootstrap


@dataclass(frozen=True)
class PairOutcome:
    """One method on one pair of the set `source`: errors (metres, degrees) and the pair's kind."""

    method: str
    source: str
    seed: int
    pair: int
    place: int
    condition: str
    metres: float
    degrees: float
    seconds: float

    def within(self, limit: float) -> bool:
        """Whether position and rotation are within `limit` metres and degrees."""
        return self.metres < limit and self.degrees < limit


def write_outcomes(outcomes: Sequence[PairOutcome], path: Path) -> None:
    """Store outcomes, so that a report needs no second run."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(PairOutcome)])
        writer.writeheader()
        writer.writerows(asdict(o) for o in outcomes)


def read_outcomes(paths: Sequence[Path]) -> list[PairOutcome]:
    """Outcomes of several runs together."""
    found: list[PairOutcome] = []
    for path in paths:
        try:
            with path.open(newline="", encoding="utf-8") as file:
                rows = [_outcome(row) for row in csv.DictReader(file)]
        except (KeyError, ValueError, TypeError, csv.Error) as error:
            raise SequenceError(f"{path}: not a CSV of this benchmark: {error}") from error
        if not rows:
            raise SequenceError(f"{path}: holds no outcomes")
        found += rows
    return found


def _outcome(row: dict[str, str]) -> PairOutcome:
    return PairOutcome(
        row["method"],
        row["source"],
        int(row["seed"]),
        int(row["pair"]),
        int(row["place"]),
        row["condition"],
        float(row["metres"]),
        float(row["degrees"]),
        float(row["seconds"]),
    )


def difference(
    a: Sequence[PairOutcome], b: Sequence[PairOutcome], limit: float = 1
) -> tuple[float, float, float]:
    """Points by which `a` beats `b` within `limit` m and deg, with a 95 % interval: a bootstrap
    over places, because the pairs of a place are alike. Both must be of the same pairs in order.
    """
    gain = np.array([x.within(limit) - float(y.within(limit)) for x, y in zip(a, b, strict=True)])
    names = [(x.source, x.seed, x.place) for x in a]
    index = {name: k for k, name in enumerate(dict.fromkeys(names))}
    group = np.array([index[name] for name in names])
    totals = np.bincount(group, gain, len(index))
    sizes = np.bincount(group, minlength=len(index))
    draws = np.random.default_rng(0).integers(0, len(index), (_DRAWS, len(index)))
    shares = totals[draws].sum(1) / sizes[draws].sum(1)
    low, high = np.percentile(100 * shares, (2.5, 97.5))
    return 100 * float(gain.mean()), float(low), float(high)
