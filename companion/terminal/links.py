"""Clickable file paths in a terminal."""

from __future__ import annotations

from pathlib import Path

from rich.style import Style
from rich.text import Text


def file_link(path: Path) -> Text:
    """The path as text that links to the file (OSC 8), if the terminal supports it."""
    full = path.resolve()
    return Text(str(path), Style(color="green", link=full.as_uri()))
