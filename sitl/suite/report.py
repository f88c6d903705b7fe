"""The suite's report: one table, a plot of the EKF error per flight, and everything as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sitl.suite.runner import ReportRow

_COLOURS = {"pass": "green", "better": "cyan", "FAIL": "red", "ERROR": "red"}
_GAP_S = 1.0  # in which the EKF reported no position
_COLUMNS = (
    "scenario",
    "vehicle",
    "reference, m",
    "measured, m",
    "what was checked",
    "verdict",
)


def print_row(console: Console, row: ReportRow) -> None:
    """One line as soon as a flight has landed."""
    colour = _COLOURS[row.verdict]
    told = row.error.splitlines()[0] if row.error else "; ".join(_broken(row))
    line = f"[{colour}]{row.verdict:6}[/] {row.vehicle} {row.case.name} ({row.wall_s:.0f} s)"
    console.print(f"{line} {escape(told)}", highlight=False)


def print_table(console: Console, rows: Sequence[ReportRow]) -> None:
    """The report as a table."""
    table = Table(*_COLUMNS, title=summary(rows))
    for row in rows:
        *cells, verdict = _cells(row)
        colour = _COLOURS[row.verdict]
        table.add_row(*(escape(c) for c in cells), f"[{colour}]{verdict}[/]")
    console.print(table)


def summary(rows: Iterable[ReportRow]) -> str:
    """How many of what, and how often the monitor spoke where it had nothing to find."""
    rows = list(rows)
    verdicts = [row.verdict for row in rows]
    counts = (f"{verdicts.count(v)} {v}" for v in _COLOURS if v in verdicts)
    honest = [row for row in rows if row.case.is_honest and row.record is not None]
    spoke = sum(bool(row.guardian_lines) for row in honest)
    return (
        f"{len(verdicts)} flights: {', '.join(counts)}; the monitor raised alerts in {spoke} of "
        f"{len(honest)} with honest fixes"
    )


def write_report(rows: Sequence[ReportRow], folder: Path) -> None:
    """suite.md, suite.json and VEHICLE-SCENARIO.png into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "suite.md").write_text(markdown(rows), encoding="utf-8")
    text = json.dumps([_as_data(row) for row in rows], indent=1)
    (folder / "suite.json").write_text(text + "\n", encoding="utf-8")
    for row in rows:
        if row.record is not None and row.record.errors:
            plot(row, folder / f"{row.vehicle}-{row.case.name}.png")


def markdown(rows: Sequence[ReportRow]) -> str:
    """The table for a document: EKF errors horizontal, median / p95 / max in metres."""
    lines = [
        "| " + " | ".join(_COLUMNS) + " |",
        "|" + "---|" * len(_COLUMNS),
        *("| " + " | ".join(c.replace("|", "/") for c in _cells(row)) + " |" for row in rows),
        "",
        summary(rows),
        "",
    ]
    return "\n".join(lines)


def plot(row: ReportRow, path: Path) -> None:
    """Horizontal EKF error over time, with the faults and what the vehicle said."""
    record = row.record
    assert record is not None
    t = np.array([e[0] for e in record.errors])
    error = np.array([np.hypot(n, e) for _, n, e in record.errors])
    figure, axes = plt.subplots(figsize=(9, 3.6), layout="constrained")
    gaps = np.flatnonzero(np.diff(t) > _GAP_S) + 1
    axes.plot(
        np.insert(t, gaps, np.nan),
        np.insert(error, gaps, np.nan),
        lw=0.9,
        color="tab:blue",
        label="EKF error",
    )
    if row.reference is not None:
        axes.axhline(row.reference.median, color="tab:green", ls="--", lw=1, label="reference")
        axes.axhline(row.measured[0] if row.measured else 0, color="tab:blue", ls=":", lw=1)
    top = max(float(error.max()) * 1.25, 0.5)
    for at_s, label in record.events:
        axes.axvline(at_s, color="tab:red", lw=1)
        axes.text(at_s, top * 0.98, f" {label}", rotation=90, va="top", size=6, color="tab:red")
    landing = [s.at_s for s in record.samples if s.mode == "LAND"]
    if landing:
        axes.axvspan(landing[0], max(landing), color="tab:orange", alpha=0.15, label="LAND")
    axes.set(xlabel="time since the scenario began, s", ylabel="horizontal EKF error, m")
    axes.set(ylim=(0, top), title=f"{row.vehicle}: {row.case.title}")
    axes.legend(loc="upper right", fontsize=7)
    figure.savefig(path, dpi=110)
    plt.close(figure)


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
    return [f"machine too slow: {row.record.starved}"]


def _as_data(row: ReportRow) -> dict[str, Any]:
    return {
        "scenario": row.case.name,
        "title": row.case.title,
        "vehicle": row.vehicle,
        "verdict": row.verdict,
        "honest": row.case.is_honest,
        "guardian": row.guardian_lines,
        "error": row.error,
        "measured": row.measured,
        "findings": [asdict(f) for f in row.findings],
        "pace": None if row.record is None else round(row.record.pace, 3),
        "stall_s": None if row.record is None else round(row.record.stall_s, 3),
        "wall_s": round(row.wall_s, 1),
        "record": None if row.record is None else asdict(row.record),
    }
