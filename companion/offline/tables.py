"""CSV tables of records as columns."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from companion.errors import RecordError
from localizer.geometry.pose import Pose, matrix_from_quaternion
from localizer.plain_files import plain_text

Columns = Mapping[str, np.ndarray]


def read_columns(path: Path, text: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Columns of a CSV file as float64 arrays, NaN where a field is empty; {} without a row.

    Columns named in `text` are strings; columns whose name ends in ``_ns`` are int64, because
    float64 would round them. A last row that a power loss cut short is left out. `RecordError` if
    the file is not a table of a record; OSError or UnicodeDecodeError if it cannot be read.
    """
    lines = io.StringIO(plain_text(path, None), newline="").readlines()
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    try:
        rows = list(csv.DictReader(lines))
    except csv.Error as error:
        raise RecordError(f"{path}: not a table of a record: {error}") from error
    names = rows[0].keys() if rows else []
    columns: dict[str, np.ndarray] = {}
    try:
        for name in names:
            values = [row[name] for row in rows]
            if name in text:
                columns[name] = np.array(values)
            elif name.endswith("_ns"):
                columns[name] = np.array([int(v) for v in values], dtype=np.int64)
            else:
                columns[name] = np.array([float(v) if v else np.nan for v in values])
    except (TypeError, ValueError, OverflowError) as error:
        raise RecordError(f"{path}: not a table of a record: {error}") from error
    return columns


def poses(columns: Columns) -> list[Pose]:
    """Rows with east_m, north_m, up_m and qw..qz as poses world_from_camera."""
    t = np.column_stack([columns[k] for k in ("east_m", "north_m", "up_m")])
    q = np.column_stack([columns[k] for k in ("qw", "qx", "qy", "qz")])
    return [Pose(matrix_from_quaternion(qi), ti) for qi, ti in zip(q, t, strict=True)]
