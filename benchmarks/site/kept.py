"""Results that are kept: one JSON each under docs/results/data, and the tables that they become.

A kept result says what made it: the command, the commit, the day and the machine. `source` names
the JSON that the command wrote; where it wrote none, the figures are those that it printed.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.common.figures import markdown
from companion.errors import ReportError

DATA = Path("docs/results/data")
_MARK = re.compile(r"<!-- (kept|criteria) ([\w\- ]+) -->\n.*?<!-- end -->", re.S)


@dataclass(frozen=True)
class PrintedTable:
    """Cells as they are printed."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def markdown(self) -> str:
        """As Markdown has it."""
        return markdown(self.columns, self.rows)


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
    """A page with its marked tables made anew.

    ``<!-- kept A B -->`` up to ``<!-- end -->`` is the table of results A and B, which have the
    same columns; ``<!-- criteria A -->`` what was needed beside what was found.
    """

    def made(mark: re.Match[str]) -> str:
        kind, names = mark.group(1), mark.group(2).split()
        parts = [load(folder / f"{name}.json") for name in names]
        tables = [part.criteria if kind == "criteria" else part.table for part in parts]
        body = _together([table for table in tables if table is not None], parts)
        origins = "\n\n".join(_origins(parts))
        return f"<!-- {kind} {' '.join(names)} -->\n{body}\n\n{origins}\n<!-- end -->"

    return _MARK.sub(made, text)


def _origins(parts: Sequence[Kept]) -> list[str]:
    """The lines below a table: what made it, once for the parts that say the same."""
    alike: dict[tuple[str, str, bool], list[Kept]] = {}
    for part in parts:
        alike.setdefault((part.command, part.machine, bool(part.source)), []).append(part)
    lines = []
    for (command, machine, written), some in alike.items():
        sources = ", ".join(dict.fromkeys(f"`{part.source}`" for part in some))
        of = f"from its {sources} of" if written else "a print of it, whose JSON was not kept, at"
        commits = ", ".join(dict.fromkeys(part.commit for part in some))
        days = ", ".join(dict.fromkeys(part.date for part in some))
        word = "commits" if "," in commits else "commit"
        line = f"*`{command}`; {of} {word} {commits}, {days}; {machine}.*"
        lines.append(
            "\n".join(textwrap.wrap(line, 120, break_long_words=False, break_on_hyphens=False))
        )
    return lines


def _together(tables: Sequence[PrintedTable], parts: Sequence[Kept]) -> str:
    columns = tables[0].columns
    if any(table.columns != columns for table in tables):
        raise ReportError(f"tables of one mark differ in their columns: {columns}")
    several = len({part.commit for part in parts}) > 1
    rows = tuple(
        (*row, part.commit) if several else row
        for table, part in zip(tables, parts, strict=True)
        for row in table.rows
    )
    return PrintedTable((*columns, "commit") if several else columns, rows).markdown


def _table(data: dict[str, Any]) -> PrintedTable:
    return PrintedTable(tuple(data["columns"]), tuple(tuple(row) for row in data["rows"]))
