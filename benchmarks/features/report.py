"""Outcomes of the feature benchmark as CSV and as tables with confidence intervals."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from localizer.errors import SequenceError
from localizer.synth.appearance.model import CONDITIONS

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


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share, in percent."""
    if count == 0:
        return 0.0, 100.0
    z, p = 1.96, hits / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * np.sqrt(p * (1 - p) / count + z * z / (4 * count**2))
    return 100 * max(middle - half, 0.0), 100 * min(middle + half, 1.0)


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


def groups(outcomes: Sequence[PairOutcome]) -> dict[str, list[PairOutcome]]:
    """All, each set and each seed of a set where there are several, each condition over all sets,
    and where there are several sets each condition in each.
    """
    sources = list(dict.fromkeys(o.source for o in outcomes))
    kinds = dict.fromkeys([*CONDITIONS, *sorted({o.condition for o in outcomes})])
    found = {"all": list(outcomes)}
    for source in sources:
        mine = [o for o in outcomes if o.source == source]
        name = f"{source}: " if len(sources) > 1 else ""
        if name:
            found[f"{name}all"] = mine
        seeds = sorted({o.seed for o in mine})
        if len(seeds) > 1:
            found |= {f"{name}seed {s}": [o for o in mine if o.seed == s] for s in seeds}
    for condition in kinds:
        mine = [o for o in outcomes if o.condition == condition]
        where = dict.fromkeys(o.source for o in mine)
        found[condition] = mine
        if len(where) > 1:
            for source in where:
                found[f"{source}: {condition}"] = [o for o in mine if o.source == source]
    return {name: members for name, members in found.items() if members}


def report(outcomes: Sequence[PairOutcome]) -> str:
    """Markdown tables. First, per group and method the share within 1 m / 1 deg with Wilson's
    interval and within 3 m / 3 deg, and the medians; then, per group, the last method's lead over
    each other one at 1 m / 1 deg, and where it is behind.
    """
    by_method = {
        m: [o for o in outcomes if o.method == m] for m in dict.fromkeys(o.method for o in outcomes)
    }
    split = {m: groups(mine) for m, mine in by_method.items()}
    methods = list(by_method)
    lines = ["| pairs | n | " + " | ".join(methods) + " |", "|---" * (len(methods) + 2) + "|"]
    for name, members in split[methods[0]].items():
        cells = [_cell(split[m].get(name, [])) for m in methods]
        lines.append(f"| {name} | {len(members)} | " + " | ".join(cells) + " |")
    medians = [_medians(mine) for mine in by_method.values()]
    lines.append("| median error | | " + " | ".join(medians) + " |")
    return "\n".join(lines + (_leads(split) if len(methods) > 1 else []))


def _leads(split: dict[str, dict[str, list[PairOutcome]]]) -> list[str]:
    *others, last = split
    lines = ["", f"Points by which {last} leads at 1 m / 1 deg:", ""]
    lines += ["| pairs | n | " + " | ".join(others) + " |", "|---" * (len(others) + 2) + "|"]
    behind = []
    for name, mine in split[last].items():
        cells = []
        for other in others:
            gain, low, high = difference(mine, split[other][name])
            mark = " **behind**" if high < 0 else " behind" if gain < 0 else ""
            cells.append(f"{gain:+.1f} [{low:+.1f}, {high:+.1f}]{mark}")
            if mark:
                certain = "significant" if high < 0 else "not significant"
                behind.append(
                    f"- {name}: {other}, {gain:+.1f} [{low:+.1f}, {high:+.1f}], {certain}"
                )
        lines.append(f"| {name} | {len(mine)} | " + " | ".join(cells) + " |")
    return [*lines, "", f"{last} is behind in {len(behind)} of these cells:", *behind]


def _cell(members: Sequence[PairOutcome]) -> str:
    if not members:
        return ""
    near = sum(o.within(1) for o in members)
    close = sum(o.within(3) for o in members)
    low, high = wilson(near, len(members))
    share, share3 = 100 * near / len(members), 100 * close / len(members)
    return f"{share:.0f} [{low:.0f}, {high:.0f}], {share3:.0f}"


def _medians(members: Sequence[PairOutcome]) -> str:
    metres = float(np.median([o.metres for o in members]))
    degrees = float(np.median([o.degrees for o in members]))
    return f"{metres:.2f} m, {degrees:.2f}°"
