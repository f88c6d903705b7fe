"""Which kind of folder it is, and its report in it."""

from __future__ import annotations

from pathlib import Path

from companion.errors import RecordError
from companion.reporting.content import Report
from companion.reporting.demo import demo_report
from companion.reporting.evaluation import evaluation_report
from companion.reporting.layout import write_report
from companion.reporting.record import record_report

NAME = "report.html"


def write_page(folder: Path, out: Path | None = None) -> Path:
    """Write the report of a record, a demo or an evaluation; returns its path."""
    return write_report(report_of(folder), out or folder / NAME)


def report_of(folder: Path) -> Report:
    """The folder's report; `RecordError` for a folder that is none of the three, or damaged."""
    try:
        return _report_of(folder)
    # What a damaged or a foreign file raises where a report takes it apart.
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, ArithmeticError) as error:
        why = f"{type(error).__name__}: {error}"
        told = f"{folder}: its files are damaged or of another version: {why}"
        raise RecordError(told) from error


def _report_of(folder: Path) -> Report:
    if (folder / "frames_report.csv").exists() and (folder / "companion").is_dir():
        return demo_report(folder)
    if (folder / "estimates.csv").exists():
        return record_report(folder)
    if (folder / "report.json").exists() and (folder / "frames.csv").exists():
        return evaluation_report(folder)
    raise RecordError(
        f"{folder}: neither a flight's record (estimates.csv), nor the folder of a demo or of "
        "`companion eval`"
    )
