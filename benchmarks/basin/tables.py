"""The tables of the convergence benchmark, as cells: what is printed, and what is kept."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.basin.run import BasinOutcome, groups, summary
from benchmarks.basin.variants import FULL
from benchmarks.basin.views import VIEWS_PER_WORLD
from benchmarks.common.shares import wilson

BOUND = 12.59  # 95 % of the chi-square of 6 degrees of freedom
COVARIANCE_COLUMNS = ("", "n", "mean NEES, its 95 % interval", "median", "within the bound, %")
_RESAMPLES = 2000

Cells = tuple[tuple[str, ...], list[tuple[str, ...]]]  # columns and rows


def row_name(source: str, view: int, photos: int) -> str:
    """The row that a view of the set `source` belongs to.

    The covariance was fitted on generated worlds, and the map's own error on photos, of even
    number; the odd ones are held out. photos: how many different ones the set has, 0: none.
    """
    if source == "generated":
        number, what = view // VIEWS_PER_WORLD, "generated, worlds"
    elif photos:
        number, what = view % photos, f"{source}, photos"
    else:
        return source
    return f"{what} of odd number" if number % 2 else f"{what} of even number, fitted"


def near(outcomes: Sequence[BasinOutcome]) -> list[BasinOutcome]:
    """Those whose covariance is asked for: within 3 m and 3 degrees."""
    return [o for o in outcomes if o.nees is not None and o.metres < 3 and o.degrees < 3]


def covariance_table(source: str, outcomes: Sequence[BasinOutcome], photos: int) -> Cells:
    """How the claimed covariance holds, of "ours" from every start together."""
    by: dict[str, list[BasinOutcome]] = {}
    for o in near([o for o in outcomes if o.variant == FULL]):
        by.setdefault(row_name(source, o.view, photos), []).append(o)
    return COVARIANCE_COLUMNS, [_covariance_row(name, mine, photos) for name, mine in by.items()]


def _covariance_row(name: str, mine: Sequence[BasinOutcome], photos: int) -> tuple[str, ...]:
    values = np.array([o.nees for o in mine], dtype=float)
    low, high = _mean_interval(values, [o.view % photos if photos else o.view for o in mine])
    inside = int((values < BOUND).sum())
    least, most = wilson(inside, len(mine))
    return (
        name, str(len(mine)), f"{values.mean():.1f} ({low:.1f}, {high:.1f})",
        f"{np.median(values):.1f}",
        f"{100 * inside / len(mine):.1f} [{least:.0f}, {most:.0f}]",
    )  # fmt: skip


def _mean_interval(values: np.ndarray, views: Sequence[int]) -> tuple[float, float]:
    """95 % of the mean by resampling pictures: registrations of one picture err alike."""
    _, index = np.unique(np.asarray(views), return_inverse=True)
    totals, sizes = np.bincount(index, values), np.bincount(index)
    draws = np.random.default_rng(0).integers(0, len(sizes), (_RESAMPLES, len(sizes)))
    means = totals[draws].sum(1) / sizes[draws].sum(1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def ablation_table(source: str, outcomes: Sequence[BasinOutcome]) -> Cells:
    """Table 4: a row a variant, a column a start; milliseconds over all starts."""
    cells = {(v, s): (mine, full) for v, s, mine, full in groups(list(outcomes))}
    starts = list(dict.fromkeys(o.start for o in outcomes))
    sizes = {s: len({o.view for o in outcomes if o.start == s}) for s in starts}
    columns = (
        "",
        *(f"{s.replace(' m ', ' m, ')}, n {sizes[s]}: R@1, change, median" for s in starts),
        "CPU ms",
    )
    rows = []
    for variant in dict.fromkeys(o.variant for o in outcomes):
        ms = float(np.median([o.milliseconds for o in outcomes if o.variant == variant]))
        found = [_ablation_cell(variant, *cells[variant, start]) for start in starts]
        rows.append((_in_set(source, variant), *found, f"{ms:.0f}"))
    return columns, rows


def _ablation_cell(variant: str, mine: list[BasinOutcome], full: list[BasinOutcome]) -> str:
    s = summary(mine, full)
    if variant == FULL:
        return f"{s['r1']:.1f} %, {s['median']:.2f} m"
    change = f"{s['change']:+.1f} ({s['change_low']:+.1f}, {s['change_high']:+.1f})"
    return f"{s['r1']:.1f} %, {change}, {s['median']:.2f} m"


def _in_set(source: str, variant: str) -> str:
    name = f"**{variant}**" if variant == FULL else variant
    return name if source == "generated" else f"{source}: {name}"
