"""Convergence of the registration: the paper's Table 4 (ablation), Table 6 and Fig. 10 (basin).

    python -m benchmarks.basin ablation FOLDER [--set generated|plain|quito|portugal|caliterra]
    python -m benchmarks.basin priors FOLDER [--set ...] [--anchors N]
    python -m benchmarks.basin axes FOLDER [--set ...] [--plot basin.png]

FOLDER keeps generated worlds, imported maps and query images between runs. Every registration
starts from a prior that is wrong by exact amounts: along a random direction and about a random axis
(ablation), or along one axis alone (axes). Shares come with Wilson's 95 % interval, medians and
differences to "ours" (same views, so paired) with bootstrap intervals over the views.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from functools import partial
from pathlib import Path

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.named_errors import named_errors, needs_torch

with needs_torch():
    from benchmarks.basin import axes as basin_axes
    from benchmarks.basin.run import Outcome, Start, groups, random_start, run, summary
    from benchmarks.basin.variants import DEFAULT_ANCHORS, FULL, our_rows, paper_rows, prior_rows
    from benchmarks.basin.views import View, load_views

STARTS = (5.0, 10.0)  # metres and degrees: the paper's columns but the easiest


def ablation_starts(index: int, sizes: tuple[float, ...]) -> list[Start]:
    """A random direction and axis for each size in metres and degrees."""
    return [random_start(size, size, index) for size in sizes]


def views_of(args: argparse.Namespace) -> list[View]:
    """The set's views; caliterra's few photos again, from other starts."""
    views = load_views(args.set, args.folder, args.data, args.pairs)
    return (
        (views * -(-args.pairs // len(views)))[: args.pairs] if len(views) < args.pairs else views
    )


def ablation(args: argparse.Namespace) -> list[Outcome]:
    """Table 4, or the priors: one line a variant and start."""
    views = views_of(args)
    rows = prior_rows(args.anchors) if args.what == "priors" else paper_rows() + our_rows()
    if args.only:
        rows = [v for v in rows if any(text in v.name for text in args.only) or v.name == FULL]
    outcomes = run(
        views, rows, partial(ablation_starts, sizes=tuple(args.starts)), args.model, args.processes
    )
    print(f"{args.set}: {len(views)} views; R@1 = share within 1 m and 1 degree")
    last = ""
    for variant, start, mine, full in sorted(
        groups(outcomes), key=lambda g: [v.name for v in rows].index(g[0])
    ):
        s = summary(mine, full)
        nees = "    -" if s["nees"] is None else f"{s['nees']:5.1f}"
        label, last = ("" if variant == last else variant), variant
        print(
            f"{label:34s} {start:9s} n={s['n']:<4.0f} R@1 {s['r1']:5.1f} "
            f"[{s['r1_low']:4.1f}, {s['r1_high']:5.1f}]  change {s['change']:+5.1f} "
            f"[{s['change_low']:+5.1f}, {s['change_high']:+5.1f}]  R@3 {s['r3']:5.1f}  "
            f"median {s['median']:5.2f} m [{s['median_low']:.2f}, {s['median_high']:.2f}]  "
            f"NEES {nees}  {s['ms']:5.1f} ms"
        )
    return outcomes


def axes(args: argparse.Namespace) -> list[Outcome]:
    """Table 6 and Fig. 10: share converged against the initial error of each axis."""
    variants = basin_axes.axis_variants()
    outcomes = run(views_of(args), variants, basin_axes.axis_starts, args.model, args.processes)
    print(args.set, end=": ")
    basin_axes.report(outcomes)
    if args.plot:
        basin_axes.plot(outcomes, args.plot)
    return outcomes


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("what", choices=("ablation", "priors", "axes"), help="table")
    parser.add_argument("folder", type=Path, help="of worlds, maps and query images")
    parser.add_argument(
        "--set", default="generated", help="generated, plain, or a folder of --data"
    )
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
    parser.add_argument("--json", type=output, help="every outcome")
    args = parser.parse_args()
    if args.set not in ("generated", "plain") and not (args.data / args.set).is_dir():
        parser.error(f"--set: {args.set!r} is neither generated, plain nor a folder of {args.data}")
    outcomes = (axes if args.what == "axes" else ablation)(args)
    if args.json:
        args.json.write_text(json.dumps([asdict(o) for o in outcomes]))


if __name__ == "__main__":
    with named_errors():
        main()
