"""Six generated places in six conditions at two heights: the paper's Table 2 with its rivals.

    python -m benchmarks.places run FOLDER [--frames 30] [--processes 2] [--minutes 5]
    python -m benchmarks.places table FOLDER [--frames 30] [--json DIR] [--plot six.png]

Each place is surveyed once and seen at other visits (what was built, felled and grown since,
another fine texture, a survey's own errors), through a rolling shutter, with a calibration and time
stamps that err. Every method is given the same pictures, the same prior of the first frame and one
core; one more row of ours hears the autopilot's turns beside them. FOLDER keeps worlds, sequences
and one JSON for each sequence and method; a killed run goes on. A short run takes consecutive
frames from a drawn place of the whole sequence, all cells in an order that makes a part of the
table a fair part. `table` counts the sequences that all methods have done. Nothing of ours is tuned
on these places.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from benchmarks.common.arguments import Parser, number, output, whole
from benchmarks.common.named_errors import named_errors
from benchmarks.places.flights import FULL, cells
from benchmarks.places.rivals import RIVALS, unavailable
from benchmarks.places.run import PlacesPlan, run
from benchmarks.places.table import draw, markdown, read_results, write_json


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("what", choices=("run", "table"), help="see above")
    parser.add_argument("folder", type=Path, help="of worlds, sequences and results")
    parser.add_argument("--frames", type=whole(2, FULL), default=FULL, help="of each sequence")
    parser.add_argument("--width", type=whole(64, 2048), default=320, help="of every method, px")
    parser.add_argument("--methods", nargs="+", choices=list(RIVALS), help="these alone")
    parser.add_argument("--processes", type=whole(1, 256), default=2, help="one core each")
    parser.add_argument("--minutes", type=number(0.1, 1e5), default=1e5,
                        help="after which no new sequence is begun")  # fmt: skip
    parser.add_argument("--json", type=Path, help="folder of the tables' figures")
    parser.add_argument("--plot", type=output, help="PNG of the errors")
    args = parser.parse_args()
    methods = tuple(args.methods or RIVALS)
    plan = PlacesPlan(args.folder, args.frames, args.width, methods, tuple(cells()))
    (_run if args.what == "run" else _table)(plan, args)


def _run(plan: PlacesPlan, args: argparse.Namespace) -> None:
    left_out = {m: why for m in plan.methods if (why := unavailable(m))}
    for why in left_out.values():
        print(f"left out: {why}")
    able = tuple(m for m in plan.methods if m not in left_out)
    plan = replace(plan, methods=able)
    for name in run(plan, args.processes, args.minutes):
        print(name, flush=True)
    left = sum(bool(plan.missing(c)) for c in plan.cells)
    print(f"{len(plan.cells) - left} of {len(plan.cells)} sequences done by all methods")


def _table(plan: PlacesPlan, args: argparse.Namespace) -> None:
    plan = replace(plan, methods=tuple(m for m in plan.methods if plan.has_any(m)))
    results = read_results(plan)
    print(markdown(plan, results))
    if args.json:
        write_json(plan, results, args.json)
    if args.plot:
        draw(plan, results, args.plot)


if __name__ == "__main__":
    with named_errors():
        main()
