"""The paper's tables from the JSON of the benchmarks, as Markdown; nothing is measured anew.

    python -m benchmarks.tables [--targets a.json ...] [--ablation basin.json] [--axes axes.json]
        [--optimizer out.json] [--depths depths.json] [--throughput a.json ...] [--out tables.md]

Table 2 is `python -m benchmarks.places table`. --targets: of `benchmarks.targets` (Table 3, flights
of one height pooled). --ablation, --axes: of `benchmarks.basin --json` (Table 4; Table 6 and
Fig. 10). --optimizer: of `benchmarks.optimizer --json` (Table 7). --depths: of `benchmarks.depths`
(Fig. 14). --throughput: of `benchmarks.throughput run`. The paper's Table 5 describes its network,
whose weights are not public. The paper's own figures stand beside as such.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.arguments import Parser, existing, output
from benchmarks.common.named_errors import named_errors
from benchmarks.common.shares import exact_interval
from localizer.errors import SequenceError

_STATIC = ("flat", "edge")
_LOOKED_S = 5.0


def targets_table(paths: Sequence[Path]) -> Iterator[str]:
    """Table 3: standing and moving targets by height, from the first fix and after looking."""
    by_height: dict[float, list[dict[str, Any]]] = defaultdict(list)
    refused: dict[float, list[int]] = defaultdict(lambda: [0, 0])
    for path in paths:
        document = _read(path)
        height = document["arguments"]["height"]
        by_height[height] += [{"file": path.name, **s} for s in document["samples"]]
        last = document["rows"][-1]
        refused[height][0] += last["refused"]
        refused[height][1] += last["sightings"]
    yield "| height, m | targets | looked | fixes (targets) | R@1 / 3 / 5 m | CE90, m | not told |"
    yield "|---|---|---|---|---|---|---|"
    for height in sorted(by_height):
        of, seen = refused[height]
        for label, kinds in (
            ("standing, flat", ("flat",)), ("standing, at edges", ("edge",)),
            ("standing, all", _STATIC), ("moving", ("car",)),
        ):  # fmt: skip
            for span, long in (("all", False), (f"from {_LOOKED_S:.0f} s", True)):
                mine = [
                    s for s in by_height[height]
                    if s["kind"] in kinds and (not long or s["looked_s"] >= _LOOKED_S)
                ]  # fmt: skip
                if mine:
                    told = f"{of} of {seen}" if (label, long) == ("standing, flat", False) else ""
                    yield f"| {height:.0f} | {label} | {span} | {_targets_row(mine)} | {told} |"
    yield "| *paper, Table 3* | *moving, one (real)* | | | *90.8 / 94.3 / 96.9* | | |"
    yield "| *paper, Table 3* | *moving, several (synthetic)* | | | *93.7 / 95.6 / 98.2* | | |"


def _targets_row(mine: Sequence[dict[str, Any]]) -> str:
    errors = np.array([s["error_m"] for s in mine])
    shares = " / ".join(f"{100 * float((errors <= m).mean()):.1f}" for m in (1, 3, 5))
    things = len({(s["file"], s["thing"]) for s in mine})
    ce90 = float(np.quantile([s["horizontal_m"] for s in mine], 0.9))
    return f"{len(mine)} ({things}) | {shares} | {ce90:.2f}"


def ablation_table(path: Path) -> Iterator[str]:
    """Table 4: share within 1 m and 1 degree by variant and start, with exact intervals."""
    outcomes = _read(path)
    starts = list(dict.fromkeys(o["start"] for o in outcomes))
    yield "| variant | " + " | ".join(f"from {s}" for s in starts) + " |"
    yield "|---" * (len(starts) + 1) + "|"
    for variant in dict.fromkeys(o["variant"] for o in outcomes):
        cells = []
        for start in starts:
            mine = [o for o in outcomes if (o["variant"], o["start"]) == (variant, start)]
            cells.append(_share([o["metres"] < 1 and o["degrees"] < 1 for o in mine]))
        yield f"| {variant} | {' | '.join(cells)} |"
    yield "| *paper: + rotation-aware hypotheses (from 3 m 3 deg, 5, 10)* | *83.8, 78.9, 70.6* |"
    yield "| *paper: + motion regularizer* | *84.3, 84.3, 84.2* |"


def axes_table(path: Path) -> Iterator[str]:
    """Table 6 and Fig. 10: the share converged by axis and initial error."""
    outcomes = _read(path)
    cells: dict[tuple[str, str], dict[float, list[bool]]] = defaultdict(lambda: defaultdict(list))
    for o in outcomes:
        axis, size = o["start"].rsplit(" ", 1)
        hit = o["metres"] < 1 and o["degrees"] < 1
        cells[o["variant"], axis][float(size)].append(hit)
    sizes = sorted({s for found in cells.values() for s in found})
    yield "| variant | axis (m or degrees) | " + " | ".join(f"{s:g}" for s in sizes) + " |"
    yield "|---" * (len(sizes) + 2) + "|"
    for (variant, axis), found in cells.items():
        shares = [f"{100 * float(np.mean(found[s])):.0f}" if found[s] else "-" for s in sizes]
        yield f"| {variant} | {axis} | {' | '.join(shares)} |"
    limits = "yaw 3.5, pitch 2.7, roll 3.2 degrees; x 5.6, y 8.1, z 7.4 m"
    yield f"| *paper, Table 6: limits* | *{limits}* |" + " |" * len(sizes)


def optimizer_table(path: Path) -> Iterator[str]:
    """Table 7: milliseconds of one LM iteration by backend and picture size."""
    document = _read(path)
    yield (
        "| milliseconds of an iteration | "
        + " | ".join(f"{s} px" for s in document["sizes"])
        + " |"
    )
    yield "|---" * (len(document["sizes"]) + 1) + "|"
    for name, values in document["iteration_ms"].items():
        cells = ["-" if v is None else f"{v:.2f}" for v in values]
        yield f"| {name} | {' | '.join(cells)} |"
    for name, values in document["paper_ms"].items():
        yield f"| *{name}* | {' | '.join(f'*{v:.2f}*' for v in values)} |"


def depths_table(path: Path) -> Iterator[str]:
    """Fig. 14 in numbers: how far two views' depths of one surface differ, both ways."""
    yield "| height, m | pixels | median | 95 % | 99 % | within 1 % | hidden from the other view |"
    yield "|---|---|---|---|---|---|---|"
    for r in _read(path)["rows"]:
        quantiles = " | ".join(f"{r[k]:.1e}" for k in ("median", "p95", "p99"))
        yield (
            f"| {r['height_m']:.0f} | {r['pixels']} | {quantiles} | "
            f"{r['within_1_percent']:.2f} % | {r['hidden_percent']:.1f} % |"
        )


def throughput_table(paths: Sequence[Path]) -> Iterator[str]:
    """The engine's rate, latency and processor time, then the stages of a frame."""
    document = [row for path in paths for row in _read(path)["rows"]]
    yield (
        "| width | cores | frames offered | frames/s | latency p50 / p95, ms | CPU ms a frame | "
        "share of the cores | median error, m |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for r in document:
        if "stage_ms" not in r:
            yield (
                f"| {r['width']} | {r['cores']} | {r['offered']} | {r['frames_per_s']:.1f} | "
                f"{r['latency_p50_ms']:.0f} / {r['latency_p95_ms']:.0f} | "
                f"{r['cpu_ms_per_frame']:.1f} | {r['share_percent']:.0f} % | {r['median_m']:.2f} |"
            )
    yield ""
    stages = [r for r in document if "stage_ms" in r]
    names = list(dict.fromkeys(name for r in stages for name in r["stage_ms"]))
    yield (
        "| CPU ms a frame, one thread | " + " | ".join(f"width {r['width']}" for r in stages) + " |"
    )
    yield "|---" * (len(stages) + 1) + "|"
    for name in names:
        yield f"| {name} | " + " | ".join(f"{r['stage_ms'][name]:.1f}" for r in stages) + " |"


def _share(hits: Sequence[bool]) -> str:
    if not hits:
        return "-"
    low, high = exact_interval(sum(hits), len(hits))
    return f"{100 * sum(hits) / len(hits):.1f} [{low:.1f}, {high:.1f}] of {len(hits)}"


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path}: not JSON of a benchmark: {error}") from error


def section(title: str, lines: Callable[[], Iterator[str]]) -> str:
    """A heading and its table; SequenceError for JSON of another benchmark."""
    try:
        return "\n".join([f"### {title}", "", *lines(), ""])
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise SequenceError(f"{title}: JSON of another benchmark: {error!r}") from error


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--targets", type=existing, nargs="+", help="JSON of benchmarks.targets")
    parser.add_argument("--ablation", type=existing, help="JSON of benchmarks.basin ablation")
    parser.add_argument("--axes", type=existing, help="JSON of benchmarks.basin axes")
    parser.add_argument("--optimizer", type=existing, help="JSON of benchmarks.optimizer")
    parser.add_argument("--depths", type=existing, help="JSON of benchmarks.depths")
    parser.add_argument(
        "--throughput", type=existing, nargs="+", help="JSON of benchmarks.throughput"
    )
    parser.add_argument("--out", type=output, help="Markdown; none: printed")
    args = parser.parse_args()
    wanted = (
        (args.targets, "Targets (the paper's Table 3)", targets_table),
        (args.ablation, "Ablation (Table 4)", ablation_table),
        (args.axes, "Convergence (Table 6, Fig. 10)", axes_table),
        (args.optimizer, "One iteration (Table 7)", optimizer_table),
        (args.depths, "Geometric consistency (Fig. 14)", depths_table),
        (args.throughput, "Throughput", throughput_table),
    )
    made = [section(title, partial(lines, given)) for given, title, lines in wanted if given]
    if not made:
        parser.error("name the JSON of at least one benchmark: see --help")
    text = "\n".join(made)
    print(text)
    if args.out:
        args.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    with named_errors():
        main()
