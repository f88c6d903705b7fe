"""Paths that a terminal opens by a click."""

from __future__ import annotations

from pathlib import Path

from rich.style import Style
from rich.text import Text


def file_link(path: Path) -> Text:
    """The path as text that leads to the file (OSC 8), where the terminal knows such links."""
    full = path.resolve()
    return Text(str(path), Style(color="green", link=full.as_uri()))
