"""``companion report``: one HTML file about a flight, a demo or an evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from companion.cli.output import tell
from companion.errors import ReportError
from companion.terminal.steps import file_link, show_steps
from companion.writing import result_file


def report_command(
    folder: Annotated[
        Path, typer.Argument(help="record, or the folder of a demo or of `companion eval`")
    ],
    out: Annotated[
        Path | None, typer.Option(help="file to write; default: report.html in the folder")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option(help="replace an existing file (the folder's own report always)")
    ] = False,
) -> None:
    """Write one self-contained HTML file and print its path."""
    if out is not None:
        result_file(out, "--out", (".html", ".htm"))
        if out.exists() and not overwrite:
            raise ReportError(f"{out}: is there already; --overwrite replaces it")
    with show_steps(Console(stderr=True)) as say:
        say(f"reading {folder}")
        from companion.reporting.report import NAME, write_page

        is_new = not (out or folder / NAME).exists()
        path = write_page(folder, out, say)
    said = "report:" if is_new else "report, in place of the one before:"
    tell(Text.assemble(f"{said} ", file_link(path)))
