"""`companion calibrate flight` on drawn errors: what it finds, and the flight after it.

    python -m benchmarks.calibration FOLDER [--minutes 5]
    python -m benchmarks.calibration FOLDER --record-only
    python -m benchmarks.calibration FOLDER --report [--json out.json]

Each draw is an aircraft whose deployment is wrong (focal length to 3 %, boresight to 3 deg an axis,
stamps to 150 ms, map to 3 m; principal point, distortion, lever arm and readout as the honest world
has them), flown for three minutes in shadow on a simulated clock (`desk`) over another visit
than the map's. Its record is calibrated; then another flight of 50 s is localized with the old, the
found and the true deployment. A run goes on where the last one ended. Seeds from 100 on were looked
at while the method was made; those of the report, from 200 on, were not.
"""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.calibration.report import COLUMNS, rows_of, summary
from benchmarks.calibration.run import TRUTH, record_draw, solve_draw
from benchmarks.common.arguments import Parser, number, output, whole
from benchmarks.common.deadline import deadline
from benchmarks.common.figures import show_figures
from benchmarks.common.lines import read_lines
from benchmarks.common.named_errors import named_errors
from sitl.demo.assets import prepare


def parser() -> Parser:
    """The command line."""
    p = Parser(__doc__)
    p.add_argument("folder", type=Path, help="of flights and outcomes")
    p.add_argument("--draws", type=whole(1, 1000), default=10, help="how many flights")
    p.add_argument("--first", type=whole(0, 10**6), default=200, help="seed of the first draw")
    p.add_argument("--world", type=whole(0, 10**9), default=1, help="seed of the world")
    p.add_argument("--minutes", type=number(0.1, 1e4), default=5.0, help="until it pauses")
    p.add_argument("--record-only", action="store_true", help="fly and localize; solve later")
    p.add_argument("--no-flight-after", action="store_true", help="calibrate only")
    p.add_argument("--report", action="store_true", help="of what is there; no run")
    p.add_argument("--json", type=output, help="the report")
    return p


def main() -> None:
    args = parser().parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    path = args.folder / "draws.jsonl"
    rows = read_lines(path) if path.exists() else []
    if not args.report:
        more_time = deadline(args.minutes)
        assets = prepare(args.world)
        done = {row["seed"] for row in rows}
        left = [s for s in range(args.first, args.first + args.draws) if s not in done]
        while left and more_time():
            seed = left.pop(0)
            folder = args.folder / f"{seed}"
            if not (folder / TRUTH).is_file():
                record_draw(assets, seed, folder)
            if not args.record_only:
                known = json.loads((folder / TRUTH).read_text())
                row = solve_draw(assets, known, folder, not args.no_flight_after)
                with path.open("a") as file:
                    file.write(json.dumps(row) + "\n")
            print(f"draw {seed}: done, {len(left)} left", flush=True)
        rows = read_lines(path) if path.exists() else []
    if rows:
        made = summary(rows)
        print(f"{made['draws']} draws")
        show_figures(args.json, COLUMNS, rows_of(made), made)


if __name__ == "__main__":
    with named_errors():
        main()
