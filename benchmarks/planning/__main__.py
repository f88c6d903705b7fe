"""Forecasts of `companion plan` against registrations of another visit's pictures, leg by leg.

    python -m benchmarks.planning FOLDER [--minutes 5]
    python -m benchmarks.planning FOLDER --report [--json out.json]
    python -m benchmarks.planning FOLDER --set tuning [--fit]

FOLDER keeps generated worlds (two honest visits each: buildings, trees and fine texture differ, the
map has a survey's own errors) and one file of legs a set; a run goes on where the last one ended.
Legs of 80 m are drawn over a world, some look over its edges: 30 to 260 m high, looking straight
down to 35 degrees below the horizon, in every condition. Of each, `localizer.forecast` sees the map
and the name of the condition; then six pictures of the other visit under that condition's weather
are registered from drawn priors. A leg failed where more than a fifth of its pictures were refused
or ended more than 1 m off. The constants of `localizer/forecast/forecast.py` are fitted on the set
"tuning"; the report is of "held-out", whose worlds had no part in them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.common.arguments import Parser, number, output, whole
from benchmarks.common.deadline import deadline
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.planning.report import COLUMNS, fitted, rows_of, summary
from benchmarks.planning.run import FlownLeg, read, run_world
from localizer.forecast.forecast import RISK_LIMIT, SIGMA
from localizer.synth.config import Character
from sitl.demo.assets import prepare

SETS: dict[str, tuple[tuple[int, float, Character], ...]] = {
    "tuning": (
        (2_400_000, 800.0, "mixed"),
        (0, 1600.0, "mixed"),
        (5, 400.0, "mixed"),
        (2_500_001, 400.0, "fields"),
        (2_500_002, 400.0, "forest"),
        (2_500_003, 400.0, "mixed"),
        (2_500_004, 400.0, "dense"),
    ),
    "held-out": (
        (2_600_001, 400.0, "mixed"),
        (2_600_002, 400.0, "dense"),
        (2_600_003, 400.0, "fields"),
        (2_600_004, 400.0, "forest"),
    ),
}


def parser() -> Parser:
    """The command line."""
    p = Parser(__doc__)
    p.add_argument("folder", type=Path, help="of worlds and outcomes")
    p.add_argument("--set", choices=list(SETS), default="held-out", help="of worlds")
    p.add_argument("--legs", type=whole(6, 10_000), default=36, help="of each world")
    p.add_argument("--minutes", type=number(0.1, 1e4), default=5.0, help="until it pauses")
    p.add_argument("--report", action="store_true", help="of what is there; no run")
    p.add_argument("--fit", action="store_true", help="constants from what is there; no run")
    p.add_argument("--json", type=output, help="the report")
    return p


def report(legs: list[FlownLeg]) -> dict[str, Any]:
    """All legs, and by condition and world."""
    parts = {"all": legs}
    for key in ("condition", "world"):
        for value in sorted({getattr(x, key) for x in legs}):
            parts[f"{key} {value}"] = [x for x in legs if getattr(x, key) == value]
    return {name: summary(part, SIGMA, RISK_LIMIT) for name, part in parts.items()}


def main() -> None:
    args = parser().parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    path = args.folder / f"{args.set}.jsonl"
    if args.fit:
        print(json.dumps(fitted(read(path)), indent=1))
        return
    if args.report:
        made = report(read(path))
        show_figures(args.json, COLUMNS, rows_of(made), made)
        return
    more_time = deadline(args.minutes)
    for seed, size_m, character in SETS[args.set]:
        if not more_time():
            break
        assets = prepare(seed, args.folder / "worlds", print, size_m, character=character)
        left = run_world(assets, args.legs, path, more_time)
        print(f"world {seed}: {left} of {args.legs} legs left", flush=True)


if __name__ == "__main__":
    with named_errors():
        main()
