"""Convergence of the registration: the paper's Table 4 (ablation), Table 6 and Fig. 10 (basin).

    python -m benchmarks.basin ablation FOLDER [--set generated|quito|portugal|caliterra]
    python -m benchmarks.basin priors FOLDER [--set ...] [--anchors N]
    python -m benchmarks.basin covariance FOLDER [--set ...]
    python -m benchmarks.basin axes FOLDER [--set ...] [--plot basin.png]

FOLDER keeps generated worlds, imported maps and query images between runs. Every registration
starts from a prior that is wrong by exact amounts: along a random direction and about a random axis
(ablation), or along one axis alone (axes). Shares come with Wilson's 95 % interval, medians and
differences to "ours" (same views, so paired) with bootstrap intervals over the views. `covariance`
compares the errors of "ours" within 3 m and 3 degrees with their covariance (NEES; 6 is perfect).
--json keeps the table, as the documentation has it, and every outcome.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors, needs_torch

with needs_torch():
    from benchmarks.basin import axes as basin_axes
    from benchmarks.basin.run import BasinOutcome, run, sized_starts
    from benchmarks.basin.tables import Cells, ablation_table, covariance_table
    from benchmarks.basin.variants import (
        DEFAULT_ANCHORS,
        FULL,
        Variant,
        our_rows,
        paper_rows,
        prior_rows,
    )
    from benchmarks.basin.views import BasinView, load_views

STARTS = (5.0, 10.0)  # metres and degrees: the paper's columns but the easiest


def photos_of(args: argparse.Namespace) -> int:
    """How many different photos the set has; 0: its views are renders."""
    views = load_views(args.set, args.folder, args.data, args.pairs)
    return len(views) if views[0].condition == "photo" else 0


def views_of(args: argparse.Namespace) -> list[BasinView]:
    """The set's views; caliterra's few photos again, from other starts."""
    views = load_views(args.set, args.folder, args.data, args.pairs)
    return (
        (views * -(-args.pairs // len(views)))[: args.pairs] if len(views) < args.pairs else views
    )


def _registered(args: argparse.Namespace, rows: list[Variant]) -> list[BasinOutcome]:
    if args.only:
        rows = [v for v in rows if any(text in v.name for text in args.only) or v.name == FULL]
    starts = partial(sized_starts, sizes=tuple(args.starts))
    return run(views_of(args), rows, starts, args.model, args.processes)


def ablation(args: argparse.Namespace) -> tuple[list[BasinOutcome], Cells]:
    """Table 4, or the priors: one line a variant and start."""
    rows = prior_rows(args.anchors) if args.what == "priors" else paper_rows() + our_rows()
    outcomes = _registered(args, rows)
    return outcomes, ablation_table(args.set, outcomes)


def covariance(args: argparse.Namespace) -> tuple[list[BasinOutcome], Cells]:
    """NEES of "ours", those on which it was fitted apart."""
    outcomes = _registered(args, [Variant(FULL)])
    return outcomes, covariance_table(args.set, outcomes, photos_of(args))


def axes(args: argparse.Namespace) -> tuple[list[BasinOutcome], Cells]:
    """Table 6 and Fig. 10: share converged against the initial error of each axis."""
    variants = basin_axes.axis_variants()
    outcomes = run(views_of(args), variants, basin_axes.axis_starts, args.model, args.processes)
    if args.plot:
        basin_axes.plot(outcomes, args.plot)
    return outcomes, basin_axes.table(outcomes)


_TABLES: dict[str, Callable[[argparse.Namespace], tuple[list[BasinOutcome], Cells]]] = {
    "ablation": ablation, "priors": ablation, "covariance": covariance, "axes": axes,
}  # fmt: skip


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("what", choices=tuple(_TABLES), help="table")
    parser.add_argument("folder", type=Path, help="of worlds, maps and query images")
    parser.add_argument("--set", default="generated", help="generated, or a folder of --data")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="of real sets")
    parser.add_argument("--pairs", type=whole(1, 100_000), default=320, help="views")
    parser.add_argument("--processes", type=whole(1, 256), default=2, help="that register")
    parser.add_argument("--model", type=existing, help="ONNX features; none: the shipped ones")
    parser.add_argument(
        "--starts", nargs="+", type=number(0.01, 90), default=STARTS, help="m and degrees"
    )
    parser.add_argument("--anchors", type=int, default=DEFAULT_ANCHORS, help="N of `priors`")
    parser.add_argument("--only", nargs="*", help="variants whose name contains one of these")
    parser.add_argument("--plot", type=output, help="PNG of the axes' curves")
    parser.add_argument("--json", type=output, help="the table and every outcome")
    args = parser.parse_args()
    if args.set != "generated" and not (args.data / args.set).is_dir():
        parser.error(f"--set: {args.set!r} is neither generated, plain nor a folder of {args.data}")
    outcomes, (columns, rows) = _TABLES[args.what](args)
    made = {"set": args.set, "outcomes": [asdict(o) for o in outcomes]}
    show_figures(args.json, columns, rows, made)


if __name__ == "__main__":
    with named_errors():
        main()
