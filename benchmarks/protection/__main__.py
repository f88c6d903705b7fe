"""Protection levels: constants fitted on drawn faults, coverage on frames that were not fitted.

    python -m benchmarks.protection --set generated --views 80 --draws 2 --out generated.json
    python -m benchmarks.protection --set caliterra --views 50 --draws 2 --out caliterra.json
    python -m benchmarks.protection --report generated.json caliterra.json --out fit.json
    python -m benchmarks.protection --flights report-loop/* --out flights.json

Sets are those of `python -m benchmarks.basin`: generated worlds of seeds that no training uses on
another day under made weather, quito (a real mesh), caliterra (real photos). Each view is
registered with a camera whose focal length, principal point and distortion are off as --lens has
it: "careful", whose deployment states nothing of it, "calibrated", which states so much, or
"overstated", which states the least that a calibration ever does. Map shift, lever arm and late
stamps times speed are added (`draws.py`). The report fits the monitor's budget on the even views
and says how many errors of the odd ones are within the levels, with the exact 95 % interval; with
the defaults of every view, too, which is a check where --seed drew other faults than those that the
defaults were chosen on (0). A run goes on where its file ends.

With --flights (folders of `python -m sitl loop` or `demo`) it counts how many positions lay inside
the level that they had in flight: those that were injected, and those that were withheld or flown
in shadow.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.basin.views import load_views
from benchmarks.common.arguments import Parser, existing, output, whole
from benchmarks.common.figures import markdown, show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.protection import flights
from benchmarks.protection.draws import LENSES
from benchmarks.protection.fit import RISKS, Coverage, coverage, fitted, halves
from benchmarks.protection.run import FaultOutcome, run
from companion.integrity_monitor.config import ProtectionConfig
from mavlink_bridge.errors import TlogError

_COLUMNS = (
    "views, constants, risk", "within HPL", "within VPL", "HPL, VPL median, m", "worst / HPL",
)  # fmt: skip


def parser() -> Parser:
    """The command line."""
    p = Parser(__doc__)
    p.add_argument("--set", default="generated", help="generated, quito, caliterra")
    p.add_argument("--views", type=whole(2, 100_000), default=80, help="how many")
    p.add_argument("--draws", type=whole(1, 100), default=2, help="faults of each view")
    p.add_argument("--lens", choices=tuple(LENSES), default="careful", help="how well known")
    p.add_argument("--seed", type=whole(0, 1_000_000), default=0, help="of the faults")
    p.add_argument("--cache", type=Path, default=Path(".cache/basin"), help="of views and maps")
    p.add_argument("--data", type=Path, default=Path("../shared/data"), help="real sets")
    p.add_argument("--out", type=output, help="JSON of every outcome, or of the report")
    p.add_argument("--flights", type=existing, nargs="+", help="flown folders, no run")
    p.add_argument("--report", type=existing, nargs="+", help="earlier files, no run")
    return p


def read(path: Path) -> list[FaultOutcome]:
    """The outcomes of a run."""
    rows = json.loads(path.read_text())
    return [_outcome(row) for row in rows]


def _outcome(row: dict[str, Any]) -> FaultOutcome:
    given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in row.items()}
    return FaultOutcome(**given)


def report(outcomes: list[FaultOutcome]) -> dict[str, Any]:
    """Constants of the even views, coverage of the odd ones: together and by set, and by what is
    configured by default; that of every view, too.
    """
    fit_on, held_out = halves(outcomes)
    constants = fitted(fit_on)
    odd, every = _by_set(held_out), _by_set([*fit_on, *held_out])
    defaults = {risk: ProtectionConfig(risk=risk) for risk in RISKS}
    counted = {
        f"{name}, {what}, {risk:g}": coverage(some, config)
        for what, sets, configs in (
            ("odd views, fitted on even", odd, {r: constants.config(r) for r in RISKS}),
            ("odd views, defaults", odd, defaults),
            ("every view, defaults", every, defaults),
        )
        for name, some in sets.items()
        for risk, config in configs.items()
    }
    return {
        "fitted": asdict(constants),
        "fitted_on": len(fit_on),
        "registered": len(outcomes),
        "accepted": sum(o.accepted for o in outcomes),
        "coverage": {name: asdict(one) for name, one in counted.items()},
        "columns": _COLUMNS,
        "rows": [_row(name, one) for name, one in counted.items()],
    }


def _by_set(outcomes: list[FaultOutcome]) -> dict[str, list[FaultOutcome]]:
    several = len({o.lens for o in outcomes}) > 1
    named = [(f"{o.set} {o.lens}" if several else o.set, o) for o in outcomes]
    by = {name: [o for other, o in named if other == name] for name, _ in named}
    return {"all": outcomes} | by


def _row(name: str, c: Coverage) -> tuple[str, ...]:
    """For docs/explanation/integrity.md."""
    return (
        name,
        f"{c.within_hpl} of {c.frames} [{c.low:.1f}, {c.high:.1f}] %",
        f"{c.within_vpl}",
        f"{c.hpl_median_m:.2f}, {c.vpl_median_m:.2f}",
        f"{c.worst_share:.2f}",
    )


def count_flights(folders: list[Path], out: Path | None) -> None:
    """Print the shares of flown positions; what cannot be counted is named."""
    flown, left_out = [], {}
    for folder in folders:
        try:
            flown.append(flights.read_flight(folder))
        except TlogError as error:
            left_out[folder.name] = str(error)
            print(f"left out: {error}")
    found = flights.report(flown) | {"left_out": left_out}
    show_figures(out, flights.COLUMNS, flights.rows(found), found)


def main() -> None:
    args = parser().parse_args()
    if args.flights:
        count_flights(args.flights, args.out)
        return
    if args.report:
        found = report([o for path in args.report for o in read(path)])
        print(json.dumps(found["fitted"]))
        print(markdown(_COLUMNS, found["rows"]))
        if args.out:
            args.out.write_text(json.dumps(found, indent=1))
        return
    outcomes = read(args.out) if args.out and args.out.exists() else []
    done = {o.view for o in outcomes[: len(outcomes) // args.draws * args.draws]}
    outcomes = [o for o in outcomes if o.view in done]
    views = load_views(args.set, args.cache, args.data, args.views)
    for outcome in run(args.set, views, args.draws, args.seed, args.lens, skip=len(done)):
        outcomes.append(outcome)
        if args.out:  # after each one: an interrupted run keeps what it has
            args.out.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))
    print(f"{len(outcomes)} registered, {sum(o.accepted for o in outcomes)} accepted")


if __name__ == "__main__":
    with named_errors():
        main()
