"""The paper's Table 3: standing and moving targets by height, from the first fix and after 5 s.

    python -m benchmarks.targets.by_height FILE [FILE ...] [--json out.json]

FILE is what `python -m benchmarks.targets --json` wrote; flights of one height are pooled. The
paper has one moving target (real) at 90.8 / 94.3 / 96.9 %, several (synthetic) at 93.7 / 95.6 /
98.2 %.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.arguments import Parser, existing, output
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from localizer.errors import SequenceError

COLUMNS = (
    "height, m", "targets", "looked", "fixes (targets)", "R@1 / 3 / 5 m", "CE90, m", "not told",
)  # fmt: skip
_KINDS = (
    ("standing, flat", ("flat",)), ("standing, at edges", ("edge",)),
    ("standing, all", ("flat", "edge")), ("moving", ("car",)),
)  # fmt: skip
_LOOKED_S = 5.0


def by_height(paths: Sequence[Path]) -> list[tuple[str, ...]]:
    """Cells of `COLUMNS`. not told: sightings without a fix, in the first row of a height."""
    samples: dict[float, list[dict[str, Any]]] = defaultdict(list)
    not_told: dict[float, list[int]] = defaultdict(lambda: [0, 0])
    for path in paths:
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            height, last = document["arguments"]["height"], document["rows"][-1]
            samples[height] += [{"file": path.name, **s} for s in document["samples"]]
            not_told[height][0] += last["refused"]
            not_told[height][1] += last["sightings"]
        except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
            raise SequenceError(f"{path}: not JSON of benchmarks.targets: {error!r}") from error
    return [
        row
        for height in sorted(samples)
        for row in _rows(f"{height:.0f}", samples[height], "{} of {}".format(*not_told[height]))
    ]


def _rows(height: str, samples: list[dict[str, Any]], told: str) -> Iterator[tuple[str, ...]]:
    for label, kinds in _KINDS:
        for span, least_s in (("all", 0.0), (f"from {_LOOKED_S:.0f} s", _LOOKED_S)):
            mine = [s for s in samples if s["kind"] in kinds and s["looked_s"] >= least_s]
            if mine:
                yield height, label, span, *_figures(mine), told
            told = ""


def _figures(mine: list[dict[str, Any]]) -> tuple[str, str, str]:
    errors = np.array([s["error_m"] for s in mine])
    shares = " / ".join(f"{100 * float((errors <= m).mean()):.1f}" for m in (1, 3, 5))
    things = len({(s["file"], s["thing"]) for s in mine})
    ce90 = float(np.quantile([s["horizontal_m"] for s in mine], 0.9))
    return f"{len(mine)} ({things})", shares, f"{ce90:.2f}"


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("files", type=existing, nargs="+", metavar="FILE", help="flights")
    parser.add_argument("--json", type=output, help="the table, for benchmarks.site.keep")
    args = parser.parse_args()
    show_figures(args.json, COLUMNS, by_height(args.files))


if __name__ == "__main__":
    with named_errors():
        main()
