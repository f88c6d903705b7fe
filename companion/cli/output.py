"""What the commands print: lines, notes and tables."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

INTERRUPTED = 130  # the shell's convention: 128 + SIGINT


def end_at_once(*_: object) -> None:
    """Signal handler that exits at once. An exception could be raised inside an import, a
    destructor or a compiler callback, which may catch it and continue.
    """
    os._exit(INTERRUPTED)


def tell(text: str | Text, style: str | None = None, *, err: bool = False) -> None:
    """Print rich's markup without breaking lines in a log. err: to standard error."""
    Console(stderr=err).print(text, style=style, soft_wrap=True, highlight=False)


def tell_notes(notes: Iterable[str]) -> None:
    """Print each note (plain text) as a yellow line to standard error."""
    for note in notes:
        tell(escape(note), "yellow", err=True)


def tell_warnings(texts: Iterable[str]) -> None:
    """Print each warning (plain text)."""
    for text in texts:
        tell(f"[yellow]warning:[/] {escape(text)}")


def show_table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None,
    numbers: Sequence[str] = (),
) -> None:  # fmt: skip
    """Print a table of rich's markup; long cells are folded, so that no end of a name is lost.
    numbers: headings of columns that are aligned to the right.
    """
    table = Table(title=title, box=SIMPLE_HEAD)
    for name in headings:
        table.add_column(name, justify="right" if name in numbers else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console().print(table)
