"""Results that are kept: one JSON each under docs/results/data, and the tables that they become.

A kept result says what made it: the command, the commit, the day and the machine. `source` names
the JSON that the command wrote; where it wrote none, the figures are those that it printed.
"""

from __future__ import annotations

import json
import math
import re
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from companion.errors import ReportError
from sitl.demo.scenario import ScenarioError
from sitl.suite.loop.report import markdown, read_rows

DATA = Path("docs/results/data")
_MARK = re.compile(r"<!-- (kept|criteria) ([\w\- ]+) -->\n.*?<!-- end -->", re.S)
_FLIGHT = (
    "flight", "localizer median / p95 / max, m", "R@1 / 3 / 5, %", "complete, %",
    "EKF median / p95 / max, m", "in bound, %", "home, m", "fixed targets median / p95, m",
    "frames/s", "latency p50 / p95, ms",
)  # fmt: skip
_SEQUENCE = ("sequence", "frames", "median", "p95, m", "R@1 / 3 / 5, %", "complete, %", "frames/s")


@dataclass(frozen=True)
class Table:
    """Cells as they are printed."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def markdown(self) -> str:
        """As Markdown has it."""
        head, *rows = ("| " + " | ".join(line) + " |" for line in (self.columns, *self.rows))
        return "\n".join([head, "|" + "---|" * len(self.columns), *rows])


@dataclass(frozen=True)
class Kept:
    """One result. commit: of the code that ran; machine: and what else ran on it."""

    command: str
    commit: str
    date: str
    machine: str
    source: str
    table: Table
    criteria: Table | None = None

    @property
    def origin(self) -> str:
        """The line below its table."""
        of = f"from its `{self.source}` of" if self.source else "as printed, recorded at"
        line = f"*`{self.command}`; {of} commit {self.commit}, {self.date}; {self.machine}.*"
        return "\n".join(textwrap.wrap(line, 120, break_long_words=False, break_on_hyphens=False))


def load(path: Path) -> Kept:
    """ReportError where the file is no kept result."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        criteria = data.pop("criteria", None)
        return Kept(
            **{key: data[key] for key in ("command", "commit", "date", "machine", "source")},
            table=_table(data["table"]),
            criteria=None if criteria is None else _table(criteria),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ReportError(f"{path}: not a kept result: {error!r}") from error


def save(kept: Kept, path: Path) -> None:
    """As `load` reads it."""
    data = {key: value for key, value in asdict(kept).items() if value is not None}
    text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def with_tables(text: str, folder: Path) -> str:
    """A page with its marked tables made anew.

    ``<!-- kept A B -->`` up to ``<!-- end -->`` is the table of results A and B, which have the
    same columns; ``<!-- criteria A -->`` what was needed beside what was found.
    """

    def made(mark: re.Match[str]) -> str:
        kind, names = mark.group(1), mark.group(2).split()
        parts = [load(folder / f"{name}.json") for name in names]
        tables = [part.criteria if kind == "criteria" else part.table for part in parts]
        body = _together([table for table in tables if table is not None], parts)
        origins = "\n\n".join(dict.fromkeys(part.origin for part in parts))
        return f"<!-- {kind} {' '.join(names)} -->\n{body}\n\n{origins}\n<!-- end -->"

    return _MARK.sub(made, text)


def _together(tables: Sequence[Table], parts: Sequence[Kept]) -> str:
    columns = tables[0].columns
    if any(table.columns != columns for table in tables):
        raise ReportError(f"tables of one mark differ in their columns: {columns}")
    several = len({part.commit for part in parts}) > 1
    rows = tuple(
        (*row, part.commit) if several else row
        for table, part in zip(tables, parts, strict=True)
        for row in table.rows
    )
    return Table((*columns, "commit") if several else columns, rows).markdown


def tables_of(path: Path, title: str) -> tuple[Table, Table | None]:
    """What the JSON of a demo flight, of `companion eval` or of `sitl loop-table` says.

    ReportError: it is none of them.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if "flights" in data:
            return _loop_table(path), None
        if "report" in data:
            return _flight_table(data["report"], title)
        return _sequence_table(data, title), None
    except (OSError, ValueError, KeyError, TypeError, ScenarioError) as error:
        raise ReportError(f"{path}: neither a flight's nor an eval's report: {error!r}") from error


def _loop_table(path: Path) -> Table:
    lines = [line for line in markdown(read_rows(path)).splitlines() if line.startswith("|")]
    cells = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines]
    return Table(cells[0], tuple(cells[2:]))


def _flight_table(report: dict[str, Any], title: str) -> tuple[Table, Table]:
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
    return Table(_FLIGHT, (row,)), _criteria(report["criteria"])


def _criteria(criteria: Sequence[dict[str, Any]]) -> Table:
    rows = []
    for one in criteria:
        enough = one["value"] >= one["limit"] if one["at_least"] else one["value"] <= one["limit"]
        sign = ">=" if one["at_least"] else "<="
        held = "yes" if enough else "**missed**"
        found, needed = (_number(one[key], one["unit"]) for key in ("value", "limit"))
        rows.append((one["name"], found, f"{sign} {needed}", held))
    return Table(("figure", "found", "needed", "held"), tuple(rows))


def _sequence_table(data: dict[str, Any], title: str) -> Table:
    row = (
        title,
        str(data["frames"]),
        f"{data['median_translation_m']:.3f} m, {data['median_rotation_deg']:.3f}°",
        f"{data['p95_translation_m']:.2f}" if "p95_translation_m" in data else "-",
        " / ".join(_short(data[f"recall_{limit}"]) for limit in (1, 3, 5)),
        f"{data['completeness']:.1f}",
        f"{data['fps']:.1f}",
    )
    return Table(_SEQUENCE, (row,))


def _short(percent: float) -> str:
    return f"{percent:.1f}".removesuffix(".0")


def _three(figures: dict[str, float]) -> str:
    return " / ".join(f"{figures[key]:.2f}" for key in ("median", "p95", "maximum"))


def _number(value: float, unit: str) -> str:
    return "-" if not math.isfinite(value) else f"{value:.2f} {unit}"


def _table(data: dict[str, Any]) -> Table:
    return Table(tuple(data["columns"]), tuple(tuple(row) for row in data["rows"]))
