"""The figures of the results pages, drawn from the kept results."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.site.kept import DATA, Kept, load

_CRITERIA = {
    "localizer median": "localizer median", "EKF horizontal p95": "EKF p95",
    "fixed targets p95": "targets p95", "fixes in their bound": "inside 95 % bound",
    "fixes in their level": "inside level",
    "localizer R@3": "R@3",
}  # fmt: skip


_TESTS = {
    "no added test": "quality alone",
    "parts agree": "patches agree",
    "parts agree, stands out: ours": "and the peak stands out: while tracking",
    "all three: ours on trial": "and no other focal length fits better: while tentative",
}


def draw_all(root: Path) -> Iterator[Path]:
    """Write missed.png, errors.png and speed.png into docs/img of the repository at `root`."""
    results = {path.stem: load(path) for path in sorted((root / DATA).glob("*.json"))}
    figures = (("missed", 3.2, _missed), ("errors", 2.8, _errors), ("speed", 3.6, _speed))
    for name, height, draw in figures:
        figure = Figure(figsize=(8, height), layout="constrained")
        draw(figure.subplots(), results)
        path = root / "docs" / "img" / f"{name}.png"
        figure.savefig(path, dpi=110)
        yield path


def _missed(axes: Axes, results: dict[str, Kept]) -> None:
    """Found over required, per flight: right of 1 misses."""
    for row, criterion in enumerate(_CRITERIA):
        shares = []
        for kept in _demos(results).values():
            for name, found, needed, _ in kept.criteria.rows if kept.criteria else ():
                if name == criterion and found != "-":
                    share = _number(found) / _number(needed)
                    shares.append(1 / share if needed.startswith(">=") else share)
        colors = ["tab:red" if share > 1 else "tab:blue" for share in shares]
        axes.scatter(shares, [row] * len(shares), c=colors, alpha=0.6)
        missed = sum(share > 1 for share in shares)
        axes.text(1.8, row, f"{missed} of {len(shares)} missed", va="center")
    axes.axvline(1.0, color="black", linewidth=1)
    axes.set_yticks(range(len(_CRITERIA)), list(_CRITERIA.values()))
    axes.set_xlim(0, 2.25)
    axes.set_xlabel("found / allowed (1 / that where more is better); one dot a flight")


def _errors(axes: Axes, results: dict[str, Kept]) -> None:
    """Share of wrong priors that each acceptance test accepts, with the exact 95 % interval."""
    table = results["wrong-places-unseen"].table
    rows = [row for row in table.rows if row[0] in ("all", "all, focal length right")]
    for place, (name, test, cell, *_) in enumerate(reversed(rows)):
        share, low, high = map(float, re.findall(r"\d+\.\d+", cell)[:3])
        color = "tab:orange" if name == "all" else "tab:blue"
        axes.errorbar(share, place, xerr=[[share - low], [high - share]], fmt="o", color=color)
        at = max(high, 0.1) + 0.03
        axes.text(at, place, f"{cell.split(',')[0]}: {_TESTS[test]}", va="center", fontsize=8)
    axes.axvline(0.1, color="black", linewidth=1, linestyle=":")
    axes.set_yticks([])
    axes.set_xlim(-0.05, 2.6)
    axes.set_xlabel("% of wrong priors accepted; blue: focal length right; dotted: target")


def _speed(axes: Axes, results: dict[str, Kept]) -> None:
    """Median and 95th percentile of the latency of each demo flight."""
    for place, (name, kept) in enumerate(sorted(_demos(results).items(), reverse=True)):
        median, p95 = map(float, kept.table.rows[0][-1].split(" / "))
        axes.plot([median, p95], [place, place], color="tab:blue", marker="|", linewidth=3)
        axes.text(p95 + 6, place, name.removeprefix("demo-"), va="center", fontsize=7)
    axes.set_yticks([])
    axes.set_xlim(0, 620)
    axes.set_xlabel("latency of a fix, ms: median to 95th percentile, per demo flight")


def _demos(results: dict[str, Kept]) -> dict[str, Kept]:
    return {name: kept for name, kept in results.items() if name.startswith("demo-")}


def _number(cell: str) -> float:
    return float(re.findall(r"\d+\.\d+", cell)[0])
