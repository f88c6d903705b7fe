"""Detects the kind of a folder and writes its report."""

from __future__ import annotations

from pathlib import Path

from companion.errors import RecordError
from companion.reporting.content import Report
from companion.reporting.demo import demo_report
from companion.reporting.evaluation import evaluation_report
from companion.reporting.layout import write_report
from companion.reporting.pictures import silent
from companion.reporting.record import record_report
from companion.terminal.steps import Say

NAME = "report.html"


def write_page(folder: Path, out: Path | None = None, say: Say = silent) -> Path:
    """Write the report of a record, a demo or an evaluation to `out`, or ``report.html`` in its
    folder; returns the path. say: receives the present step as text. `RecordError` as of
    `report_of`, `ReportError` if it cannot be written.
    """
    report = report_of(folder, say)
    path = out or folder / NAME
    say(f"drawing the plots and writing {path}")
    return write_report(report, path)


def report_of(folder: Path, say: Say = silent) -> Report:
    """Make the folder's report, write nothing; `RecordError` if its kind or content is wrong."""
    try:
        return _report_of(folder, say)
    # What a damaged or a foreign file raises where a report takes it apart.
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, ArithmeticError) as error:
        why = f"{type(error).__name__}: {error}"
        told = f"{folder}: its files are damaged or of another version: {why}"
        raise RecordError(told) from error


def _report_of(folder: Path, say: Say) -> Report:
    if not folder.is_dir():
        there = "is a file, not a folder" if folder.exists() else "there is no such folder"
        raise RecordError(f"{folder}: {there}; give a record's, a demo's or an evaluation's")
    if (folder / "frames_report.csv").exists() and (folder / "companion").is_dir():
        return demo_report(folder, say)
    if (folder / "estimates.csv").exists():
        return record_report(folder, say)
    if (folder / "report.json").exists() and (folder / "frames.csv").exists():
        return evaluation_report(folder, say)
    raise RecordError(
        f"{folder}: neither a flight's record (estimates.csv), nor the folder of a demo or of "
        "`companion eval`"
    )
