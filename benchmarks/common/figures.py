"""A benchmark's table, printed, and as JSON: the documentation's tables are made, not copied."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.versions import made_by


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Cells as a table of Markdown."""
    head, *lines = ("| " + " | ".join(line) + " |" for line in (columns, *rows))
    return "\n".join([head, "|" + "---|" * len(columns), *lines])


def show_figures(
    path: Path | None, columns: Sequence[str], rows: Sequence[Sequence[str]],
    more: dict[str, Any] | None = None,
) -> None:  # fmt: skip
    """Print the table, and write it where `path` is given, as `write_figures` does."""
    print(markdown(columns, rows))
    if path is not None:
        write_figures(path, columns, rows, more)


def write_figures(
    path: Path, columns: Sequence[str], rows: Sequence[Sequence[str]],
    more: dict[str, Any] | None = None,
) -> None:  # fmt: skip
    """Cells as they are to be read, with the versions, the commit and the processor. more: what
    they were made of.
    """
    data = {"columns": list(columns), "rows": [list(row) for row in rows], "versions": made_by()}
    data |= {} if more is None else {"more": more}
    path.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
