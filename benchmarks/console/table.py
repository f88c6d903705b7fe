"""One table of several runs of `benchmarks.console`, or of `.browser`, for the documentation.

    python -m benchmarks.console.table RUN.json... --out TABLE.json

Each condition's figures are the medians over its runs, with the number of runs in the head.
`python -m benchmarks.site.keep` takes the file.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from benchmarks.common.arguments import Parser, existing, output
from benchmarks.common.named_errors import named_errors
from benchmarks.console.__main__ import CONDITIONS
from benchmarks.console.limits import LIMITS
from companion.errors import ReportError

# Label, limit, keys of a run whose medians stand in a cell, digits.
_ROWS: tuple[tuple[str, str, tuple[str, ...], int], ...] = (
    ("console's process, % of a core", "", ("console_percent",), 2),
    ("its thread in the flight's process, %", "", ("link_percent",), 2),
    ("flight's process, %", "", ("flight_percent",), 0),
    (
        "the browser's processes, page / map and screen / rest, %", "",
        ("browser_renderer_percent", "browser_gpu-process_percent", "browser_rest_percent"), 1,
    ),
    ("localized frames a second", "unchanged", ("localized_per_s",), 2),
    ("latency p50 / p95, ms", "unchanged", ("latency_p50_ms", "latency_p95_ms"), 0),
    ("error median / p95, m", "unchanged", ("error_median_m", "error_p95_m"), 3),
    ("pictures a second, decoded or painted", ">= {frames_per_s:g}", ("frames_per_s",), 2),
    (
        "a picture's age then, p50 / p95 / max, ms", "<= {age_ms:g}",
        ("age_p50_ms", "age_p95_ms", "age_max_ms"), 0,
    ),
    ("of it until the flight gave it out, p50 / p95", "", ("flight_p50_ms", "flight_p95_ms"), 0),
    ("of it in the console, p50 / p95", "", ("console_p50_ms", "console_p95_ms"), 0),
    ("of it on the way to the page, p50 / p95", "", ("way_p50_ms", "way_p95_ms"), 0),
    ("of it until decoded or painted, p50 / p95", "", ("browser_p50_ms", "browser_p95_ms"), 0),
)  # fmt: skip


def table(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Columns and rows of text."""
    by = {c: [r for r in runs if r["condition"] == c] for c in CONDITIONS}
    there = [c for c in CONDITIONS if by[c]]
    if not there:
        raise ReportError("no runs of any condition in these files")
    rows = []
    for label, limit, keys, digits in _ROWS:
        cells = [_cell(by[c], keys, digits) for c in there]
        rows.append([label, limit.format(**LIMITS), *cells])
    return {"columns": ["", "limit", *(f"{c} ({len(by[c])})" for c in there)], "rows": rows}


def _cell(runs: list[dict[str, Any]], keys: tuple[str, ...], digits: int) -> str:
    told = []
    for key in keys:
        known = [r[key] for r in runs if r.get(key) is not None]
        if not known:
            return "-"
        told.append(f"{float(np.median(known)):.{digits}f}")
    return " / ".join(told)


def main() -> None:
    """Join, print, write."""
    parser = Parser(__doc__)
    parser.add_argument(
        "runs", type=existing, nargs="+", help="JSON of `benchmarks.console`, or of `.browser`"
    )
    parser.add_argument("--out", type=output, required=True, help="JSON file of the table")
    options = parser.parse_args()
    runs = [run for path in options.runs for run in json.loads(path.read_text())["runs"]]
    made = table(runs)
    print("\n".join(" | ".join(row) for row in (made["columns"], *made["rows"])))
    options.out.write_text(json.dumps(made | {"runs": runs}, indent=1))


if __name__ == "__main__":
    with named_errors():
        main()
