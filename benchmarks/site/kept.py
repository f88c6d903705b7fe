"""Results that are kept: one JSON each under docs/results/data, and the tables that they become.

A kept result names its command, commit, date and machine. `source` names the JSON that the command
wrote. If `source` is empty, the figures were copied from the command's output.
"""

from __future__ import annotations

import json
import re
import textwrap
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.common.figures import markdown
from companion.errors import ReportError

DATA = Path("docs/results/data")
_MARK = re.compile(r"<!-- kept ([\w\- ]+) -->\n.*?<!-- end -->", re.S)


@dataclass(frozen=True)
class PrintedTable:
    """Cells as they are printed."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Kept:
    """One result. commit: of the code that ran; machine: and what else ran on it."""

    command: str
    commit: str
    date: str
    machine: str
    source: str
    table: PrintedTable
    criteria: PrintedTable | None = None


def load(path: Path) -> Kept:
    """ReportError where the file is no kept result."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        criteria = data.pop("criteria", None)
        return Kept(
            **{key: data[key] for key in ("command", "commit", "date", "machine", "source")},
            table=_table(data["table"]),
            criteria=None if criteria is None else _table(criteria),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ReportError(f"{path}: not a kept result: {error!r}") from error


def save(kept: Kept, path: Path) -> None:
    """As `load` reads it."""
    data = {key: value for key, value in asdict(kept).items() if value is not None}
    text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def with_tables(text: str, folder: Path) -> str:
    """A page of docs/results with its marked tables written anew.

    ``<!-- kept A B -->`` up to ``<!-- end -->`` becomes the table of results A and B, which have
    the same columns, with links to their JSON below it.
    """

    def made(mark: re.Match[str]) -> str:
        names = mark.group(1).split()
        tables = [load(folder / f"{name}.json").table for name in names]
        columns = tables[0].columns
        if any(table.columns != columns for table in tables):
            raise ReportError(f"tables of one mark differ in their columns: {columns}")
        rows = tuple(row for table in tables for row in table.rows)
        links = ", ".join(f"[{name}](data/{name}.json)" for name in names)
        line = f"*Command, commit, date and machine: {links}.*"
        origin = "\n".join(textwrap.wrap(line, 120, break_on_hyphens=False))
        return (
            f"{mark.group(0).splitlines()[0]}\n{markdown(columns, rows)}\n\n{origin}\n<!-- end -->"
        )

    return _MARK.sub(made, text)


def _table(data: dict[str, Any]) -> PrintedTable:
    return PrintedTable(tuple(data["columns"]), tuple(tuple(row) for row in data["rows"]))
