"""The feature benchmark's tables as cells, for the documentation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.common.figures import markdown
from benchmarks.common.shares import wilson
from benchmarks.features.report import PairOutcome, difference
from localizer.synth.appearance.model import CONDITIONS

Cells = tuple[tuple[str, ...], list[tuple[str, ...]]]  # columns and rows

# What a row calls the kinds of pairs; photos are taken by day.
_KINDS = {
    **{name: name for name in CONDITIONS}, "photo": "day", "photo, coarser map": "coarser map",
    "season": "another season", "outdated map": "outdated map", "photo, older map": "outdated map",
    "combined": "any weather, season, outdated map together",
}  # fmt: skip


def by_set(outcomes: Sequence[PairOutcome]) -> Cells:
    """A row a set, a column a method."""
    named = {s: [o for o in outcomes if o.source == s] for s in _sources(outcomes)}
    return _by_method("pairs", named | ({"all": list(outcomes)} if len(named) > 1 else {}))


def by_condition(outcomes: Sequence[PairOutcome]) -> Cells:
    """A row a kind of pair, a column a method, over all sets; the median errors at the end."""
    named = {"all": list(outcomes)}
    columns, rows = _by_method("pairs", named | {k: _of(outcomes, k) for k in _kinds(outcomes)})
    of = [[o for o in outcomes if o.method == m] for m in _methods(outcomes)]
    medians = (
        f"{np.median([o.metres for o in mine]):.2f} m, {np.median([o.degrees for o in mine]):.2f}°"
        for mine in of
    )
    return columns, [*rows, ("median error", "", *medians)]


def by_light(outcomes: Sequence[PairOutcome]) -> Cells:
    """A row a kind of pair, a column a set: the last method alone."""
    mine = [o for o in outcomes if o.method == _methods(outcomes)[-1]]
    sets = _sources(mine)
    rows = []
    for kind in _kinds(mine):
        found = [[o for o in _of(mine, kind) if o.source == s] for s in sets]
        rows.append((kind, *(f"{_shares(some)} (n {len(some)})" if some else "" for some in found)))
    return ("light and weather", *sets), rows


def leads(outcomes: Sequence[PairOutcome]) -> Cells:
    """Points by which the last method leads at 1 m and 1 degree: over all, by set and by kind."""
    *others, last = _methods(outcomes)
    named = {"all": list(outcomes)}
    named |= {s: [o for o in outcomes if o.source == s] for s in _sources(outcomes)}
    rows = []
    for name, some in (named | {k: _of(outcomes, k) for k in _kinds(outcomes)}).items():
        mine = [o for o in some if o.method == last]
        found = (difference(mine, [o for o in some if o.method == m]) for m in others)
        texts = (f"{gain:+.1f} [{low:+.1f}, {high:+.1f}]" for gain, low, high in found)
        rows.append((name, str(len(mine)), *texts))
    return (f"lead of {last}, points", "n", *(f"over {m}" for m in others)), rows


def against(outcomes: Sequence[PairOutcome]) -> Cells:
    """The last method against the first, on the same pairs: a row a set, and its hard kinds."""
    first, *_, last = _methods(outcomes)
    rows = []
    for source in _sources(outcomes):
        mine = [o for o in outcomes if o.source == source]
        named = {source: mine} | {
            f"{source}: {kind}": some
            for kind in ("dusk", "combined")
            if len(some := [o for o in mine if o.condition == kind]) < len(mine) and some
        }
        for name, some in named.items():
            old, new = ([o for o in some if o.method == m] for m in (first, last))
            leads = (difference(new, old, limit) for limit in (1, 3))
            texts = (f"{gain:+.1f} [{low:+.1f}, {high:+.1f}]" for gain, low, high in leads)
            places = len({(o.seed, o.place) for o in new})
            rows.append((name, str(len(new)), str(places), _shares(old), _shares(new), *texts))
    columns = ("pairs", "n", "places", first, last, "points, 1 m and 1°", "points, 3 m and 3°")
    return columns, rows


TABLES: dict[str, Callable[[Sequence[PairOutcome]], Cells]] = {
    "sets": by_set, "conditions": by_condition, "light": by_light, "leads": leads,
    "against": against,
}  # fmt: skip


def report(outcomes: Sequence[PairOutcome]) -> str:
    """The tables by set and by kind of pair, and the leads of the last method, as Markdown."""
    wanted = [by_set, by_condition, *([leads] if len(_methods(outcomes)) > 1 else [])]
    return "\n\n".join(markdown(*table(outcomes)) for table in wanted)


def _by_method(title: str, named: dict[str, list[PairOutcome]]) -> Cells:
    methods = _methods([o for some in named.values() for o in some])
    rows = []
    for name, some in named.items():
        of = [[o for o in some if o.method == m] for m in methods]
        rows.append((name, str(len(of[-1])), *(_with_interval(mine) for mine in of)))
    return (title, "n", *methods), rows


def _with_interval(mine: Sequence[PairOutcome]) -> str:
    low, high = wilson(sum(o.within(1) for o in mine), len(mine))
    one, three = _shares(mine).split(", ")
    return f"{one} [{low:.0f}, {high:.0f}], {three}"


def _shares(mine: Sequence[PairOutcome]) -> str:
    """Per cent within 1 m and 1 degree, then within 3 m and 3 degrees."""
    return ", ".join(f"{100 * sum(o.within(k) for o in mine) / len(mine):.0f}" for k in (1, 3))


def _methods(outcomes: Sequence[PairOutcome]) -> list[str]:
    return list(dict.fromkeys(o.method for o in outcomes))


def _sources(outcomes: Sequence[PairOutcome]) -> list[str]:
    return list(dict.fromkeys(o.source for o in outcomes))


def _kinds(outcomes: Sequence[PairOutcome]) -> list[str]:
    """Those that are there, in the table's order, unknown ones last."""
    there = dict.fromkeys(_KINDS.get(o.condition, o.condition) for o in outcomes)
    known = [k for k in dict.fromkeys(_KINDS.values()) if k in there]
    return [*known, *(k for k in there if k not in known)]


def _of(outcomes: Sequence[PairOutcome], kind: str) -> list[PairOutcome]:
    return [o for o in outcomes if _KINDS.get(o.condition, o.condition) == kind]
