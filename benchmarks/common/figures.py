"""A benchmark's table as JSON, so that the documentation's tables are made and not copied."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.versions import made_by


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
