"""False accepts: single registrations from wrong beginnings, and the right ones that tests cost.

    python -m benchmarks.integrity FOLDER [--sets generated quito ...] [--minutes 10]
    python -m benchmarks.integrity FOLDER --without SEEN
    python -m benchmarks.integrity FOLDER --fit localizer/integrity/probability.json
    python -m benchmarks.integrity FOLDER --report [--json out.json]

FOLDER keeps worlds, maps, views and one file of outcomes a set (`integrity/SET.jsonl`); a run goes
on where the last one ended, and ends after so many minutes. Every view begins near the truth (3 m,
8 m), 20 to 200 m and 5 to 180 degrees off, at 20 other places of its map, at 13 of other maps, and
with a focal length that is 5 % off. Roll, pitch and height are known as an autopilot knows them,
and every prior tells its own error, so that the gate against the prior is as wide as it deserves. A
false accept is a wrong beginning that ends accepted and more than 3 m or 3 degrees off (beside it:
more than 10 m). The set "tuning" is for choosing thresholds and in no figure of the report. On
"shifted" a result counts by the place that the map's picture shows: no single picture tells that a
map is shifted. --fit: the probability of `localizer.integrity.probability` is fitted to the
outcomes of all sets but "shifted" and the dark ones; each set is also judged by a fit without its
kind. --without: the views that another folder has outcomes of are left out, so that a limit that
was chosen on those is held against others. The set "unseen" is run where it is named.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from benchmarks.common.arguments import Parser, existing, number, output
from benchmarks.common.deadline import deadline
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.integrity.fit import fit, fit_table
from benchmarks.integrity.maps import DARK, SETS, TUNING, UNSEEN, load_set
from benchmarks.integrity.report import COLUMNS, cells, rows
from benchmarks.integrity.run import StartOutcome, read, run_set, turn
from localizer.integrity.acceptance import IntegrityConfig

_USUAL = [name for name in SETS if name != UNSEEN]
_TURN = 8  # views of a set before it is the next one's turn


def parser() -> Parser:
    """The command line."""
    p = Parser(__doc__)
    p.add_argument("folder", type=Path, help="of worlds, maps, views and outcomes")
    p.add_argument("--sets", nargs="+", choices=list(SETS), default=_USUAL, help="to run")
    p.add_argument("--data", type=Path, default=Path("../shared/data"), help="real sets")
    p.add_argument("--minutes", type=number(0.1, 1e4), default=10.0, help="until it pauses")
    p.add_argument("--fit", type=output, help="probability.json from the outcomes that are there")
    p.add_argument("--without", type=existing, help="folder whose outcomes' views are left out")
    p.add_argument("--report", action="store_true", help="tables of what is there; no run")
    p.add_argument("--json", type=output, help="the report's table and rows")
    return p


def main() -> None:
    args = parser().parse_args()
    home = args.folder / "integrity"
    home.mkdir(parents=True, exist_ok=True)
    if not (args.report or args.fit):
        more_time = deadline(args.minutes)
        wanted = args.sets if args.sets == [TUNING] else list(dict.fromkeys(_USUAL + args.sets))
        views = {n: load_set(n, args.folder, args.data, SETS[n]) for n in wanted}
        usual = [n for n in _USUAL if n in views and n != TUNING and not n.startswith(DARK)]
        left = dict.fromkeys(args.sets, 1)
        while any(left.values()) and more_time():
            for name in (n for n in args.sets if left[n]):  # in turns, so that a part tells, too
                # Thresholds were chosen on the tuning set's map: no other set sees it, nor it them.
                kept = [] if name == TUNING else [v for n in usual for v in views[n]]
                mine = name, views[name], kept, home / f"{name}.jsonl", turn(more_time, _TURN)
                seen = args.without and args.without / "integrity" / f"{name}.jsonl"
                left[name] = run_set(*mine, seen)
                print(f"{name}: {left[name]} of {len(views[name])} views left", flush=True)
        return
    outcomes: list[StartOutcome] = []
    for name in (n for n in args.sets if n != TUNING or args.sets == [TUNING]):
        if (home / f"{name}.jsonl").exists():
            outcomes += read(home / f"{name}.jsonl")
    if args.fit:
        fitted = fit(outcomes)
        args.fit.write_text(json.dumps(fitted, indent=2) + "\n")
        print(fit_table(fitted))
        return
    made = rows(outcomes, IntegrityConfig())
    show_figures(args.json, COLUMNS, cells(made), {"rows": [asdict(r) for r in made]})


if __name__ == "__main__":
    with named_errors():
        main()
