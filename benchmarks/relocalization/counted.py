"""All simulated relocalizations together: how many answers were false, with the exact interval.

    python -m benchmarks.relocalization.counted FILE [FILE ...] [--json out.json]

FILE is what `python -m benchmarks.relocalization --out` wrote (one frame against a whole map: one
relocalization each) or `python -m benchmarks.relocalization.motion --out` (one flight without a
place each, however many frames it searched; false where the search or a pose that was given out
was). Where the view is not on the map that was searched every answer is false. The share that is
refused is told, too: never to answer is no merit.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common.arguments import Parser, existing, output
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.common.shares import exact_interval

COLUMNS = ("relocalizations", "heading", "of", "right", "refused", "false, % [95 %]")
_ELSEWHERE = ("not on this map", "elsewhere")


@dataclass(frozen=True)
class One:
    """A relocalization. kind: what was asked; heading_known: to 15 degrees."""

    kind: str
    heading_known: bool
    right: bool
    false: bool


def one(row: dict[str, Any]) -> One:
    """Of a row of either benchmark."""
    flown = "trial" in row
    what = "a flight without a place" if flown else "one frame, the whole map"
    if any(mark in row["set"] for mark in _ELSEWHERE):
        what += " of another place"
    elif row["set"] == "roofs":
        what += " of equal houses"
    if flown:
        false = row["wrong"] > 0 or row["false"] > 0
        right = row["confirmed_s"] is not None and not false
    else:
        false, right = row["false"], row["found"]
    return One(what, row["heading_known"], right, false)


def cells(found: Sequence[One]) -> list[tuple[str, ...]]:
    """A line for each kind, and one for all."""
    groups = sorted({(o.kind, not o.heading_known) for o in found})
    lines = [
        _line(kind, "unknown" if unknown else "15°",
              [o for o in found if (o.kind, not o.heading_known) == (kind, unknown)])
        for kind, unknown in groups
    ]  # fmt: skip
    return [*lines, _line("all", "any", found)]


def _line(kind: str, heading: str, some: Sequence[One]) -> tuple[str, ...]:
    n, right, false = len(some), sum(o.right for o in some), sum(o.false for o in some)
    low, high = exact_interval(false, n)
    return (
        kind, heading, str(n), str(right), str(n - right - false),
        f"{false}, {100 * false / n:.2f} [{low:.2f}, {high:.2f}]",
    )  # fmt: skip


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("files", type=existing, nargs="+", metavar="FILE", help="outcomes")
    p.add_argument("--json", type=output, help="the table")
    args = p.parse_args()
    found = [one(row) for path in args.files for row in _rows(path)]
    if not found:
        raise RuntimeError("no relocalization in these files")
    made = cells(found)
    show_figures(args.json, COLUMNS, made)


def _rows(path: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))
    return rows


if __name__ == "__main__":
    with named_errors():
        main()
