"""``companion export``: a record for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from companion.errors import ConfigError
from companion.terminal.steps import shown_steps


def export_command(
    record: Annotated[
        Path, typer.Argument(help="folder that `companion run` recorded, or a demo's")
    ],
    mcap: Annotated[
        bool, typer.Option("--mcap", help="MCAP for Foxglove, Lichtblick and Rerun")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="file to write; none: record.mcap in the record")
    ] = None,
    tlog: Annotated[Path | None, typer.Option(help="instead of the record's bridge.tlog")] = None,
) -> None:
    """Write a record in a format that other programs open."""
    if not mcap:
        raise ConfigError("say which format: --mcap")
    console = Console()
    with shown_steps(console) as say:
        say(f"reading {record}")
        from companion.reporting.mcap_export import export_mcap

        written = export_mcap(record, out, tlog, lambda n: say(f"{n} messages written"))
    for note in written.notes:
        console.print(f"note: {escape(note)}", soft_wrap=True, highlight=False)
    path = escape(str(written.path))
    console.print(f"{written.messages} messages: [green]{path}[/]", soft_wrap=True, highlight=False)
