"""The suite's report: one table, and everything as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from companion.writing import write_result
from sitl.suite.runner import ReportRow

_COLOURS = {"pass": "green", "better": "cyan", "FAIL": "red", "ERROR": "red"}
_COLUMNS = (
    "scenario",
    "vehicle",
    "reference, m",
    "measured, m",
    "what was checked",
    "verdict",
)


def print_row(console: Console, row: ReportRow) -> None:
    """Print one flight's result."""
    colour = _COLOURS[row.verdict]
    told = row.error.splitlines()[0] if row.error else "; ".join(_broken(row))
    line = f"[{colour}]{row.verdict:6}[/] {row.vehicle} {row.case.name} ({row.wall_s:.0f} s)"
    console.print(f"{line} {escape(told)}", highlight=False)


def summary(rows: Iterable[ReportRow]) -> str:
    """Text: number of flights passed, and false alarms of the monitor."""
    rows = list(rows)
    verdicts = [row.verdict for row in rows]
    counts = (f"{verdicts.count(v)} {v}" for v in _COLOURS if v in verdicts)
    honest = [row for row in rows if row.case.is_honest and row.record is not None]
    spoke = sum(bool(row.monitor_alerts) for row in honest)
    return (
        f"{len(verdicts)} flights: {', '.join(counts)}; the monitor raised alerts in {spoke} of "
        f"{len(honest)} with honest fixes"
    )


def write_report(rows: Sequence[ReportRow], folder: Path) -> None:
    """Write suite.md and suite.json into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_result(folder / "suite.md", markdown(rows))
    text = json.dumps([_as_data(row) for row in rows], indent=1)
    write_result(folder / "suite.json", text + "\n")


def markdown(rows: Sequence[ReportRow]) -> str:
    """Markdown table; EKF errors are horizontal: median / p95 / max in metres."""
    lines = [
        "| " + " | ".join(_COLUMNS) + " |",
        "|" + "---|" * len(_COLUMNS),
        *("| " + " | ".join(c.replace("|", "/") for c in _cells(row)) + " |" for row in rows),
        "",
        summary(rows),
        "",
    ]
    return "\n".join(lines)


def _cells(row: ReportRow) -> tuple[str, ...]:
    reference = row.reference
    wanted = ""
    if reference is not None:
        wanted = _three((reference.median, reference.p95, reference.max))
    told = row.error.splitlines()[0] if row.error else "; ".join(_told(row))
    return (
        row.case.name,
        row.vehicle,
        wanted,
        _three(row.measured or ()),
        told,
        row.verdict,
    )


def _three(values: Iterable[float | None]) -> str:
    return " / ".join("-" if v is None else f"{v:.2f}" for v in values)


def _told(row: ReportRow) -> list[str]:
    return [f.what if f.ok else f"NOT: {f.what}" for f in row.findings] + _pace(row)


def _broken(row: ReportRow) -> list[str]:
    return [f.what for f in row.findings if not f.ok] + _pace(row)


def _pace(row: ReportRow) -> list[str]:
    if row.record is None or not row.slow:
        return []
    return [f"machine too slow: {row.record.pace_text}"]


def _as_data(row: ReportRow) -> dict[str, Any]:
    return {
        "scenario": row.case.name,
        "title": row.case.title,
        "vehicle": row.vehicle,
        "verdict": row.verdict,
        "honest": row.case.is_honest,
        "guardian": row.monitor_alerts,
        "error": row.error,
        "measured": row.measured,
        "findings": [asdict(f) for f in row.findings],
        "pace": None if row.record is None else round(row.record.pace, 3),
        "stall_s": None if row.record is None else round(row.record.stall_s, 3),
        "wall_s": round(row.wall_s, 1),
        "record": None if row.record is None else asdict(row.record),
    }
