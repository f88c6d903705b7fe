"""A run's metrics as rows of a CSV."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path


def append(log: Path, row: Mapping[str, float]) -> None:
    """Append a row to a run's CSV; writes the header first if the file is new."""
    new = not log.exists()
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", newline="") as file:
        writer = csv.DictWriter(file, row.keys())
        if new:
            writer.writeheader()
        writer.writerow({name: f"{value:.5g}" for name, value in row.items()})
