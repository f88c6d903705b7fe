"""Relocalization: one frame against the whole map, no prior; share found and confirmed, and cost.

    python -m benchmarks.relocalization --set generated --views 80 --heading known --out out.json
    python -m benchmarks.relocalization --set quito --views 48 --heading unknown
    python -m benchmarks.relocalization --set quito --on FOLDER/generated/2000001/survey.cache
    python -m benchmarks.relocalization --report out.json more.json [--json table.json]

Sets are those of `python -m benchmarks.basin`: generated worlds of seeds that no training uses, the
query on another day under made weather; quito, a real mesh (map and query from the same mesh);
caliterra, real photos. With --on the views are searched on a map on which they are not: every
answer is false. A run with --out goes on where the last one ended. Autopilot and barometer are
drawn about the truth: roll and pitch 0.7 degrees, height 2 m; heading uniform within 15 degrees, or
anything. Found and confirmed: accepted, and within 3 m and 3 degrees; false: accepted and not.
Times are medians; the wall's are this
machine's, with whatever else runs on it.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from benchmarks.basin.views import load_views
from benchmarks.common.arguments import Parser, existing, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.relocalization.run import (
    COLUMNS,
    ViewOutcome,
    ViewSearch,
    cells,
    run,
    with_threads,
)
from localizer.config import LocalizerConfig


def parser() -> Parser:
    """The command line."""
    p = Parser(__doc__)
    p.add_argument("--set", default="generated", help="generated, quito, caliterra")
    p.add_argument("--views", type=whole(1, 100_000), default=40, help="how many")
    p.add_argument(
        "--heading", choices=("known", "unknown", "both"), default="both", help="to 15 degrees"
    )
    p.add_argument("--on", type=existing, help="tile cache of another place, to be searched")
    p.add_argument("--first", type=whole(0, 100_000), default=0, help="view to begin with")
    p.add_argument("--threads", type=whole(1, 64), default=2, help="of a search")
    p.add_argument("--seed", type=whole(0, 1_000_000), default=0, help="of the sensors' errors")
    p.add_argument("--cache", type=Path, default=Path(".cache/basin"), help="of views and maps")
    p.add_argument("--data", type=Path, default=Path("../shared/data"), help="real sets")
    p.add_argument("--out", type=output, help="JSON of every outcome")
    p.add_argument("--report", type=existing, nargs="+", help="table of earlier files, no run")
    p.add_argument("--json", type=output, help="the table")
    return p


def main() -> None:
    args = parser().parse_args()
    if args.report:
        rows = [ViewOutcome(**row) for path in args.report for row in json.loads(path.read_text())]
        show_figures(args.json, COLUMNS, cells(rows))
        return
    config = with_threads(LocalizerConfig(), args.threads)
    views = load_views(args.set, args.cache, args.data, args.views)
    kept = json.loads(args.out.read_text()) if args.out and args.out.exists() else []
    outcomes = [ViewOutcome(**row) for row in kept]
    for known in {"known": (True,), "unknown": (False,), "both": (True, False)}[args.heading]:
        done = sum(o.heading_known is known for o in outcomes)
        asked = ViewSearch(args.set, config, known, args.seed, args.on)
        for outcome in run(asked, views, args.first + done):
            outcomes.append(outcome)
            if args.out:  # after each one: an interrupted run keeps what it has
                args.out.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))
    show_figures(args.json, COLUMNS, cells(outcomes))


if __name__ == "__main__":
    with named_errors():
        main()
