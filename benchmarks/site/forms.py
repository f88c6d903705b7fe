"""The tables of what the repository's commands write: one function for each form of JSON.

`benchmarks.common.figures.write_figures` is the form of benchmarks that have a table of their own.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.site.kept import PrintedTable
from companion.errors import ReportError
from sitl.demo.scenario import ScenarioError
from sitl.suite.loop.evaluation import markdown, read_rows

_FLIGHT = (
    "flight", "localizer median / p95 / max, m", "R@1 / 3 / 5, %", "complete, %",
    "EKF median / p95 / max, m", "in bound, %", "home, m", "fixed targets median / p95, m",
    "frames/s", "latency p50 / p95, ms",
)  # fmt: skip
_SEQUENCE = ("sequence", "frames", "median", "p95, m", "R@1 / 3 / 5, %", "complete, %", "frames/s")
_SUITE = ("scenario", "what happens", "vehicle", "EKF median / p95 / max, m", "verdict")
_FOLLOWED = (
    "flight", "followed", "seen, of reports", "back after a roof, s", "median / p95 / max, m",
    "inside its 95 %", "velocity p95, m/s", "of something else",
)  # fmt: skip


def tables_of(
    paths: Sequence[Path], title: str, only: Sequence[str] = ()
) -> tuple[PrintedTable, PrintedTable | None]:
    """The table of one result, and what was needed beside what was found where the report says.

    paths: several files of one form; title: of a row that has no name of its own, behind the names
    of those that have one; only: rows of these names. ReportError: no form that is known.
    """
    if not paths:
        raise ReportError("no report to keep")
    try:
        data = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
        if isinstance(data[0], dict) and "report" in data[0]:
            return _flight(data[0]["report"], title)
        if isinstance(data[0], dict) and "flights" in data[0]:
            return _loop(paths, title, only), None
        table = _form(data[0])(data, title)
    except (OSError, ValueError, KeyError, IndexError, TypeError, ScenarioError) as error:
        raise ReportError(f"{paths[0]}: not a report of a form that is known: {error!r}") from error
    return _picked(table, only), None


def _picked(table: PrintedTable, only: Sequence[str]) -> PrintedTable:
    rows = tuple(row for row in table.rows if not only or row[0] in only)
    return PrintedTable(table.columns, rows)


def _form(data: Any) -> Callable[[list[Any], str], PrintedTable]:
    marks = data if isinstance(data, dict) else data[0]
    for mark, made in (
        ("columns", _figures), ("recall_1", _sequence), ("begin_ns", _followed),
        ("verdict", _suite),
    ):  # fmt: skip
        if mark in marks:
            return made
    raise KeyError("none of the marks of a form")


def _figures(data: list[Any], _title: str) -> PrintedTable:
    rows = (tuple(map(str, row)) for one in data for row in one["rows"])
    return PrintedTable(tuple(data[0]["columns"]), tuple(rows))


def _loop(paths: Sequence[Path], title: str, only: Sequence[str]) -> PrintedTable:
    rows = [row for path in paths for row in read_rows(path) if not only or row.name in only]
    table = _of_markdown(markdown(rows))
    if not title:
        return table
    named = tuple((f"{row[0]} ({title})", *row[1:]) for row in table.rows)
    return PrintedTable(table.columns, named)


def _of_markdown(text: str) -> PrintedTable:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines]
    return PrintedTable(cells[0], tuple(cells[2:]))


def _flight(report: dict[str, Any], title: str) -> tuple[PrintedTable, PrintedTable]:
    localizer, latency = report["localizer"], report["stages_ms"]["latency"]
    ekf = report.get("ekf_in_map_m") or report["ekf_horizontal_m"]
    row = (
        title,
        _three(report["localizer_m"]),
        " / ".join(_short(localizer[f"recall_{limit}"]) for limit in (1, 3, 5)),
        f"{localizer['completeness']:.1f}",
        _three(ekf),
        f"{report['inside_bound']:.1f}" if "inside_bound" in report else "-",
        f"{report['home_error_m']:.1f}",
        " / ".join(f"{report['fixed_targets_m'][key]:.2f}" for key in ("median", "p95")),
        f"{localizer['fps']:.1f}",
        f"{latency['median']:.0f} / {latency['p95']:.0f}",
    )
    return PrintedTable(_FLIGHT, (row,)), _criteria(report["criteria"])


def _criteria(criteria: Sequence[dict[str, Any]]) -> PrintedTable:
    rows = []
    for one in criteria:
        enough = one["value"] >= one["limit"] if one["at_least"] else one["value"] <= one["limit"]
        sign = ">=" if one["at_least"] else "<="
        held = "yes" if enough else "**missed**"
        # A third digit where two hide that it was missed.
        digits = 2 if enough or round(one["value"], 2) != round(one["limit"], 2) else 3
        found, needed = (_number(one[key], one["unit"], digits) for key in ("value", "limit"))
        rows.append((one["name"], found, f"{sign} {needed}", held))
    return PrintedTable(("figure", "found", "needed", "held"), tuple(rows))


def _sequence(data: list[Any], title: str) -> PrintedTable:
    one = data[0]
    row = (
        title,
        str(one["frames"]),
        f"{one['median_translation_m']:.3f} m, {one['median_rotation_deg']:.3f}°",
        f"{one['p95_translation_m']:.2f}" if "p95_translation_m" in one else "-",
        " / ".join(_short(one[f"recall_{limit}"]) for limit in (1, 3, 5)),
        f"{one['completeness']:.1f}",
        f"{one['fps']:.1f}",
    )
    return PrintedTable(_SEQUENCE, (row,))


def _suite(data: list[Any], _title: str) -> PrintedTable:
    rows = []
    for one in (row for part in data for row in part):
        broken = "; ".join(f["what"] for f in one["findings"] or () if not f["ok"])
        verdict = f"**{one['verdict']}**" if one["verdict"] in ("FAIL", "ERROR") else one["verdict"]
        told = " ".join(filter(None, (verdict, broken, one["error"].split("\n")[0])))
        measured = " / ".join(f"{m:.2f}" for m in one["measured"] or ())
        rows.append((one["scenario"], one["title"], one["vehicle"], measured, told))
    return PrintedTable(_SUITE, tuple(sorted(rows)))


def _followed(data: list[Any], _title: str) -> PrintedTable:
    return PrintedTable(_FOLLOWED, tuple(_pursuit(row) for part in data for row in part))


def _pursuit(row: dict[str, Any]) -> tuple[str, ...]:
    """A flight of `sitl follow`."""
    name, verdict = f"{row['vehicle']}, world {row['seed']}, draw {row['draw']}", row["verdict"]
    if verdict is None:
        return (name, f"**not flown**: {row['error']}", *("-",) * (len(_FOLLOWED) - 2))
    told = "yes" if verdict["is_followed"] else f"**no**: {'; '.join(verdict['why'])}"
    return (
        name, told, f"{verdict['seen']} of {verdict['reports']}",
        ", ".join(f"{s:.1f}" for s in verdict["back_s"]),
        " / ".join(f"{verdict[f'{k}_m']:.2f}" for k in ("p50", "p95", "max")),
        f"{verdict['inside_percent']:.0f} %", f"{verdict['velocity_p95_mps']:.2f}",
        str(verdict["foreign"]),
    )  # fmt: skip


def _short(percent: float) -> str:
    return f"{percent:.1f}".removesuffix(".0")


def _three(figures: dict[str, float]) -> str:
    return " / ".join(f"{figures[key]:.2f}" for key in ("median", "p95", "maximum"))


def _number(value: float, unit: str, digits: int) -> str:
    return "-" if not math.isfinite(value) else f"{value:.{digits}f} {unit}"
