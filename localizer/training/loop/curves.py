"""Plots a run's metrics."""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib as mpl

from localizer.errors import SequenceError


def plot(log: Path) -> Path:
    """Plot every column of a run's CSV over its steps; returns the PNG beside it. `SequenceError`
    if the file is not a run's CSV.
    """
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    try:
        with log.open(newline="", encoding="utf-8") as file:
            rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]
    except (ValueError, TypeError, csv.Error) as error:
        raise SequenceError(f"{log}: not a run's CSV: {error}") from error
    if not rows or "step" not in rows[0]:
        raise SequenceError(f"{log}: not a run's CSV: holds no row with a step")
    names = [k for k in rows[0] if k not in ("step", "seconds", "core_seconds")]
    figure, axes = plt.subplots(-(-len(names) // 4), 4, figsize=(14, 2.4 * -(-len(names) // 4)))
    for axis, name in zip(axes.flat, names, strict=False):
        axis.plot([r["step"] for r in rows], [r[name] for r in rows], lw=1)
        axis.set_title(name, fontsize=9)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(names) :]:
        axis.set_axis_off()
    figure.tight_layout()
    out = log.with_suffix(".png")
    figure.savefig(out, dpi=90)
    plt.close(figure)
    return out
