"""The product's judgement on real imagery: what it accepts, and how wrong it says that it may be.

    python -m benchmarks.real FOLDER [--sets fengyuan neon ...] [--attitudes 0.3 1 3 none]
    python -m benchmarks.real FOLDER --search --json search.json

FOLDER keeps the maps between runs. Each image begins from a prior up to 10 m off; roll, pitch and
the height (3 m) are reported with the stated sigma, or not at all. A registration is right where
the middle of its image lies on its true ground. NEES: squared error over the claimed covariance and
the truth's own, per degree of freedom, the median of the accepted. --search: each image without a
prior, heading unknown, on its map and on one that does not hold it; their table goes to --json.
--displaced N: only wrong priors, N of each image, 45 to 110 m off while they claim 6 m; roll and
pitch known to 1 degree.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.common.arguments import Parser, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from benchmarks.real.judged import ATTITUDES, JudgedImage, judged_images
from benchmarks.real.report import (
    DISPLACED,
    JUDGED,
    SEARCHED,
    attitude_text,
    displaced_cells,
    displaced_row,
    judged_cells,
    judged_row,
    plot,
    searched_cells,
    searched_row,
)
from benchmarks.real.searched import searched_images
from benchmarks.real.sets import SETS, RealView, describe, load

_JUDGED_AT = 1.0  # degrees of attitude, of displaced priors
_ELSEWHERE = {"caliterra": "fengyuan"}  # whose map holds no place of a set; else caliterra's
_SEARCHED = ("fengyuan", "caliterra")


def parser() -> Parser:
    """The command line."""
    p = Parser(__doc__)
    p.add_argument("folder", type=Path, help="of the maps that are built")
    p.add_argument("--data", type=Path, default=Path("../shared/data"), help="real data")
    p.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS), help="to judge")
    names = {attitude_text(a).rstrip("°"): a for a in ATTITUDES}
    p.add_argument(
        "--attitudes",
        nargs="+",
        choices=list(names),
        default=list(names),
        help="sigma of roll and pitch, degrees",
    )
    p.add_argument("--width", type=whole(64, 2048), default=320, help="working width, px")
    p.add_argument("--search", action="store_true", help="without a prior, too")
    p.add_argument("--displaced", type=whole(1, 100), default=0, help="wrong priors of each image")
    p.add_argument("--json", type=output, help="rows and every image")
    p.add_argument("--plot", type=output, help="PNG: error over protection level")
    return p


def main() -> None:
    args = parser().parse_args()
    wanted = [a for a in ATTITUDES if attitude_text(a).rstrip("°") in args.attitudes]
    views = {name: load(name, args.folder, args.data) for name in args.sets}
    judged: list[JudgedImage] = []
    rows: list[dict[str, Any]] = []
    result: dict[str, Any] = {"settings": {"width": args.width}}
    if args.displaced:
        found = [_displaced(name, views[name], args) for name in args.sets]
        more = result | {"displaced": found}
        show_figures(args.json, DISPLACED, list(map(displaced_cells, found)), more)
        return
    for name in args.sets:
        for attitude in wanted:
            images = list(judged_images(name, describe(name), views[name], attitude, args.width))
            judged += images
            rows.append(judged_row(images))
            print(" | ".join(judged_cells(rows[-1])), flush=True)
    result["judged"] = rows
    columns: Sequence[str] = JUDGED
    cells = list(map(judged_cells, rows))
    if args.search:
        result["searched"] = [
            searched_row(list(searched_images(name, views[name], _map_of(name, args), args.width)))
            for name in args.sets
            if name in _SEARCHED
        ]
        columns, cells = SEARCHED, list(map(searched_cells, result["searched"]))
    result["images"] = [asdict(i) for i in judged]
    show_figures(args.json, columns, cells, result)
    if args.plot:
        plot(judged, args.plot)


def _displaced(name: str, views: Sequence[RealView], args: Any) -> dict[str, Any]:
    """The row of one set from all its wrong priors."""
    images = [
        judged_images(name, describe(name), views, _JUDGED_AT, args.width, seed)
        for seed in range(args.displaced)
    ]
    return displaced_row(list(itertools.chain.from_iterable(images)))


def _map_of(name: str, args: Any) -> Path:
    """A map that holds no place of a set."""
    other = _ELSEWHERE.get(name, "caliterra")
    return load(other, args.folder, args.data)[0].map_cache


if __name__ == "__main__":
    with named_errors():
        main()
