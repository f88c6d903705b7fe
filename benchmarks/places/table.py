"""The table of the six places from its JSON: Markdown and a plot, nothing measured anew.

Frames of a sequence err alike, and so do the sequences of a place, which share its map: intervals
are bootstraps over the places, within one place over its sequences.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.figures import markdown as table
from benchmarks.common.figures import write_figures
from benchmarks.places.flights import CONDITIONS, HEIGHT_M, HEIGHTS
from benchmarks.places.rivals import MISSING, OURS, RIVALS
from benchmarks.places.run import PRIOR, PlacesPlan
from benchmarks.places.worlds import PLACES
from localizer.errors import SequenceError
from localizer.evaluation.sequences import LocalizationMetrics, localization_metrics
from localizer.geometry.pose import Array

_DRAWS = 1000
_COLUMNS = (
    "method", "median, m", "median, deg", "R@1 / 3 / 5", "completeness",
    "beyond 3 m or 3°, of answered", "frames/s of one core",
)  # fmt: skip
_WRONG = 3.0  # beyond so many metres or degrees
_WARM = 3  # frames at the beginning that no rate is measured on: three passes, tiles to load
# Table 2 of the paper, SynthCity-6: its own pictures, maps and machine (512 px, a GPU).
PAPER = (
    ("Render2ORB", "4.37", "0.21", "18.0 / 30.2 / 55.3", "38.4", "20"),
    ("Render2RAFT", "5.21", "0.62", "8.4 / 32.5 / 48.9", "96.2", "10"),
    ("PixLoc", "0.55", "0.06", "65.4 / 92.3 / 98.2", "96.5", "5"),
    ("Render2Loc (RoMaV2)", "0.47", "0.04", "77.2 / 98.8 / 99.6", "100.0", "0.8"),
    ("PiLoT", "0.46", "0.03", "80.4 / 99.9 / 99.9", "100.0", "28"),
)


@dataclass(frozen=True)
class Result:
    """One method on one sequence. metres, degrees (F,): NaN without an answer; cpu_ms (F,)."""

    place: str
    condition: str
    height: str
    method: str
    metres: Array
    degrees: Array
    cpu_ms: Array


def read_results(plan: PlacesPlan) -> list[Result]:
    """Of the sequences that all of the plan's methods have done."""
    return [
        _read(plan.result(cell, method))
        for cell in plan.cells
        if not plan.missing(cell)
        for method in plan.methods
    ]


def _read(path: Path) -> Result:
    try:
        d = json.loads(path.read_text())
        metres, degrees, cpu = (np.array(d[k], float) for k in ("metres", "degrees", "cpu_ms"))
        return Result(d["place"], d["condition"], d["height"], d["method"], metres, degrees, cpu)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SequenceError(f"{path}: not a result of this benchmark: {error}") from error


def measures(results: Sequence[Result]) -> LocalizationMetrics:
    """The paper's measures over all frames; frames a second of one core, by processor time."""
    cpu = np.concatenate([r.cpu_ms[_WARM:] for r in results])
    metres = np.concatenate([r.metres for r in results])
    degrees = np.concatenate([r.degrees for r in results])
    seconds = len(metres) * float(np.median(cpu)) * 1e-3
    return localization_metrics(metres, degrees, seconds)


def interval(
    results: Sequence[Result], value: Callable[[Array], float | None]
) -> tuple[float, float] | None:
    """95 % interval of a measure of errors (F, 2), bootstrap over the places; None without one."""
    rng = np.random.default_rng(0)
    drawn: list[float] = []
    blocks = _blocks(results)
    for _ in range(_DRAWS):
        picked = [blocks[k] for k in rng.integers(0, len(blocks), len(blocks))]
        found = value(np.concatenate(picked))
        if found is not None:
            drawn.append(found)
    if not drawn:
        return None
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(low), float(high)


def recall_3(errors: Array) -> float:
    """Per cent of all frames within 3 m and 3 degrees. errors (F, 2): metres, degrees."""
    return 100.0 * float(np.mean((errors <= _WRONG).all(axis=1)))


def median_m(errors: Array) -> float | None:
    """Metres of the answers; None without any."""
    answered = errors[np.isfinite(errors[:, 0]), 0]
    return float(np.median(answered)) if len(answered) else None


def _errors(results: Sequence[Result]) -> Array:
    """(F, 2): metres and degrees of every frame."""
    return np.concatenate([np.stack([r.metres, r.degrees], axis=1) for r in results])


def _blocks(results: Sequence[Result]) -> list[Array]:
    """What errs alike, together: errors of each place, or of each sequence of the only one."""
    places = dict.fromkeys(r.place for r in results)
    if len(places) == 1:
        return [_errors([r]) for r in results]
    return [_errors([r for r in results if r.place == p]) for p in places]


def write_json(plan: PlacesPlan, results: Sequence[Result], folder: Path) -> None:
    """The tables that the documentation keeps: the whole one, and medians and R@3 by group."""
    folder.mkdir(parents=True, exist_ok=True)
    write_figures(folder / "six-places.json", _COLUMNS, _rows(plan, results))
    names = ["", *(RIVALS[m].name for m in plan.methods)]
    for file, value, digits in (("median", median_m, 2), ("recall", recall_3, 0)):
        by_group = [
            [group, *(_measured([r for r in members if r.method == m], value, digits)
                      for m in plan.methods)]
            for group, members in groups(results).items()
        ]  # fmt: skip
        write_figures(folder / f"six-places-{file}.json", names, by_group)


def _rows(plan: PlacesPlan, results: Sequence[Result]) -> list[tuple[str, ...]]:
    """Under `_COLUMNS`: the plan's methods, then the paper's."""
    ours = [_row(m, [r for r in results if r.method == m]) for m in plan.methods]
    return ours + [(f"*paper: {name}*", *rest, "-", f"({fps})") for name, *rest, fps in PAPER]


def _measured(mine: Sequence[Result], value: Callable[[Array], float | None], digits: int) -> str:
    return _with_interval(value(_errors(mine)), interval(mine, value), digits)


def groups(results: Sequence[Result]) -> dict[str, list[Result]]:
    """All sequences; those of each condition, place and height."""
    found = {"all": list(results)}
    found |= {c: [r for r in results if r.condition == c] for c in CONDITIONS}
    found |= {p.name: [r for r in results if r.place == p.name] for p in PLACES}
    found |= {h: [r for r in results if r.height == h] for h in HEIGHTS}
    return {name: members for name, members in found.items() if members}


def markdown(plan: PlacesPlan, results: Sequence[Result]) -> str:
    """What was run, the whole table, then median and R@3 by condition, place and height."""
    if not results:
        return "No sequence has been done by all methods yet."
    count = len(results) // len(plan.methods)
    frames = sum(len(r.metres) for r in results) // len(plan.methods)
    cells = [
        (group, str(len(members) // len(plan.methods)),
         *(_short([r for r in members if r.method == m]) for m in plan.methods))
        for group, members in groups(results).items()
    ]  # fmt: skip
    settings = [(RIVALS[m].name, RIVALS[m].settings) for m in plan.methods]
    return "\n".join(
        [
            f"{count} of {len(plan.cells)} sequences (six places, {len(CONDITIONS)} conditions, "
            f"low: {HEIGHT_M['low']:.0f} m, high: {HEIGHT_M['high']:.0f} m), {plan.frames} "
            f"consecutive frames each at 10 a second ({frames} in all), working width "
            f"{plan.width}; the first frame's prior up to {PRIOR.translation_m:.0f} m and "
            f"{PRIOR.rotation_deg:.0f} degrees off, no other is given. 95 % intervals over places.",
            "",
            table(_COLUMNS, _rows(plan, results)),
            "",
            "Median in metres (R@3 in per cent) by group:",
            "",
            table(("", "sequences", *(name for name, _ in settings)), cells),
            "",
            table(("method", "settings"), settings),
            "",
            f"Not run: {MISSING}.",
        ]
    )


def _row(method: str, mine: Sequence[Result]) -> tuple[str, ...]:
    m = measures(mine)
    median = _with_interval(m.median_translation_m, interval(mine, median_m), 2)
    recall = f"{m.recall_1:.1f} / {m.recall_3:.1f} / {m.recall_5:.1f}"
    between = interval(mine, recall_3)
    if between:
        recall += f" (R@3 {between[0]:.0f} to {between[1]:.0f})"
    return (
        RIVALS[method].name, median, _number(m.median_rotation_deg, 2), recall,
        f"{m.completeness:.1f}", _false(mine), f"{m.fps:.1f}",
    )  # fmt: skip


def _false(mine: Sequence[Result]) -> str:
    """Answers that are wrong, of all that were given: what an autopilot would have followed."""
    errors = _errors(mine)
    answered = errors[np.isfinite(errors[:, 0])]
    return f"{np.count_nonzero((answered > _WRONG).any(axis=1))} of {len(answered)}"


def _short(mine: Sequence[Result]) -> str:
    m = measures(mine)
    return f"{_number(m.median_translation_m, 2)} ({m.recall_3:.0f})"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _with_interval(value: float | None, between: tuple[float, float] | None, digits: int) -> str:
    if value is None or between is None:
        return _number(value, digits)
    return f"{value:.{digits}f} [{between[0]:.{digits}f}, {between[1]:.{digits}f}]"


def draw(plan: PlacesPlan, results: Sequence[Result], path: Path) -> None:
    """Share of all frames within an error, a curve for each method, a panel for each condition."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    shown = [c for c in CONDITIONS if any(r.condition == c for r in results)]
    figure, axes = plt.subplots(2, 3, figsize=(11, 6.5), sharex=True, sharey=True)
    for axis, condition in zip(axes.ravel(), shown, strict=False):
        for method in plan.methods:
            mine = [r for r in results if (r.condition, r.method) == (condition, method)]
            x, y = _curve(np.concatenate([r.metres for r in mine]))
            ours = {"linewidth": 2.5, "color": "black"} if method == OURS else {"linewidth": 1.2}
            axis.step(x, y, where="post", label=RIVALS[method].name, **ours)
        axis.set(title=condition, xscale="log", xlim=(0.03, 30), ylim=(0, 100))
        axis.grid(alpha=0.3)
    axes[1, 1].set_xlabel("position error, m")
    axes[0, 0].set_ylabel("% of all frames")
    axes[1, 0].set_ylabel("% of all frames")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=4, fontsize=8)
    figure.tight_layout(rect=(0, 0.07, 1, 1))
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _curve(metres: Array) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    found = np.sort(metres[np.isfinite(metres)])
    return found, 100.0 * np.arange(1, len(found) + 1) / max(len(metres), 1)
