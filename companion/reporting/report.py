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
    """The folder's report; `RecordError` for a folder that is none of the three."""
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
