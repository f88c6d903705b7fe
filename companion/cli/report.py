"""``companion report``: one HTML file about a flight, a demo or an evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from companion.errors import ReportError
from companion.terminal.links import file_link
from companion.terminal.steps import shown_steps


def report_command(
    folder: Annotated[
        Path, typer.Argument(help="record, or the folder of a demo or of `companion eval`")
    ],
    out: Annotated[
        Path | None, typer.Option(help="file to write; none: report.html in the folder")
    ] = None,
) -> None:
    """Write one self-contained HTML file and print its path."""
    if out is not None and out.suffix.lower() not in (".html", ".htm") and not out.is_dir():
        raise ReportError(f"{out}: give a name that ends in .html")
    console = Console()
    with shown_steps(console) as say:
        say(f"reading {folder}")
        from companion.reporting.report import write_page

        path = write_page(folder, out, say)
    console.print("report:", file_link(path), soft_wrap=True, highlight=False)
