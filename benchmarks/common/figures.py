"""A benchmark's table as JSON, so that the documentation's tables are made and not copied."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from companion.versions import made_by


def write_figures(path: Path, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Cells as they are to be read, with the versions, the commit and the processor."""
    data = {"columns": list(columns), "rows": [list(row) for row in rows], "versions": made_by()}
    path.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
