"""The paper's Table 6 and Fig. 10: how far off a prior may be along each axis alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.basin.run import BasinOutcome, Start, groups, random_start, summary
from benchmarks.basin.tables import Cells
from benchmarks.basin.variants import FULL, Variant
from localizer.registration.config import JNGOConfig

AXES = ("yaw", "pitch", "roll", "x", "y", "z")  # camera axes; yaw about y, pitch about x
STEPS = (1.0, 2.0, 4.0, 6.0, 8.0, 11.0, 15.0)  # degrees or metres
PAPER = {"yaw": 3.5, "pitch": 2.7, "roll": 3.2, "x": 5.6, "y": 8.1, "z": 7.4}  # Table 6
_RESAMPLES = 400
_JOINT = STEPS[-3:]

Shares = dict[tuple[str, str], list[BasinOutcome]]


def axis_start(axis: str, size: float, seed: int) -> Start:
    """An error of `size` degrees or metres along one camera axis, of a random sign."""
    sign = 1.0 if np.random.default_rng((seed, AXES.index(axis))).random() < 0.5 else -1.0
    shift, turn = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    if axis in ("x", "y", "z"):
        shift["xyz".index(axis)] = sign * size
    else:
        turn[{"pitch": 0, "yaw": 1, "roll": 2}[axis]] = sign * float(np.radians(size))
    return Start(f"{axis} {size:.0f}", (shift[0], shift[1], shift[2]), (turn[0], turn[1], turn[2]))


def axis_starts(index: int) -> list[Start]:
    """Of every axis, and of all jointly, one size; together the views try all of them."""
    starts = []
    for k, axis in enumerate(("all", *AXES)):
        size = STEPS[(index + k) % len(STEPS)]
        if axis == "all":
            joint = random_start(size, size, index)
            starts.append(Start(f"all {size:.0f}", joint.shift, joint.turn))
        else:
            starts.append(axis_start(axis, size, index))
    return starts


def axis_variants() -> list[Variant]:
    """Fig. 10: one hypothesis on the levels from coarse, from mid or from fine on; and the swarm.

    A level that is left out gets no iterations. All end with the same sharpening, so that
    "converged" means the same: within 1 m and 1 degree.
    """
    one = JNGOConfig(hypotheses=1)
    return [
        Variant("one hypothesis, fine level", replace(one, iterations=(0, 0, 15))),
        Variant("one, mid and fine", replace(one, iterations=(0, 5, 10))),
        Variant("one, coarse to fine", one),
        Variant(FULL),
    ]


def table(outcomes: list[BasinOutcome]) -> Cells:
    """The limits beside Table 6, and the shares from the three largest errors of all axes."""
    cells = {(v, s): mine for v, s, mine, _ in groups(outcomes)}
    columns = ("", *AXES, f"from {' / '.join(f'{s:.0f}' for s in _JOINT)} m and ° in all, %")
    rows = [
        ("the paper, Table 6", *(f"{PAPER[a]} {_unit(a)}".replace(" °", "°") for a in AXES), "")
    ]
    for name in dict.fromkeys(o.variant for o in outcomes):
        joint = [f"{x:.0f}" for x in shares(cells, name, "all")[-len(_JOINT) :]]
        found = [limit_text(limits(cells, name, a)) for a in AXES]
        rows.append((f"**{name}**" if name == FULL else name, *found, " / ".join(joint)))
    return columns, rows


def limit_text(found: tuple[float, float, float]) -> str:
    """A limit with its interval."""
    value, low, high = (most(v) for v in found)
    return value if value == low == high else f"{value} [{low}, {high}]"


def shares(cells: Shares, name: str, axis: str) -> list[float]:
    """Per cent converged, of each of `STEPS`."""
    return [100 * float(np.mean([o.hit for o in cells[name, f"{axis} {s:.0f}"]])) for s in STEPS]


def limit(shares: list[float]) -> float:
    """The error from which half as many converge as from the least error, between the steps
    linearly; infinite where more do from every step. The paper does not define its limit.
    """
    level = 0.5 * shares[0]
    for k in range(1, len(STEPS)):
        if shares[k] < level:
            part = (shares[k - 1] - level) / (shares[k - 1] - shares[k])
            return STEPS[k - 1] + part * (STEPS[k] - STEPS[k - 1])
    return np.inf


def limits(cells: Shares, name: str, axis: str) -> tuple[float, float, float]:
    """The limit with its bootstrap interval, registrations resampled within each size."""
    rng = np.random.default_rng(0)
    hits = [np.array([o.hit for o in cells[name, f"{axis} {s:.0f}"]]) for s in STEPS]
    drawn = [
        limit([100 * float(rng.choice(h, len(h)).mean()) for h in hits]) for _ in range(_RESAMPLES)
    ]
    low, high = np.quantile(drawn, [0.025, 0.975], method="nearest")
    return limit([100 * float(h.mean()) for h in hits]), float(low), float(high)


def most(value: float) -> str:
    """A limit as text; beyond the last step it is not known."""
    return f"{value:.1f}" if np.isfinite(value) else f">{STEPS[-1]:.0f}"


def plot(outcomes: list[BasinOutcome], path: Path) -> None:
    """Share converged over the initial error, one panel an axis, with Wilson's intervals."""
    share = {(v, s): summary(mine, []) for v, s, mine, _ in groups(outcomes)}
    names = list(dict.fromkeys(o.variant for o in outcomes))
    figure, panels = plt.subplots(2, 4, figsize=(13, 6), sharey=True)
    for panel, axis in zip(panels.flat, ("all", *AXES), strict=False):
        for name in names:
            rows = [share[name, f"{axis} {s:.0f}"] for s in STEPS]
            panel.plot(STEPS, [r["r1"] for r in rows], marker="o", ms=3, label=name)
            low, high = ([r[k] for r in rows] for k in ("r1_low", "r1_high"))
            panel.fill_between(STEPS, low, high, alpha=0.15)
        if axis in PAPER:
            panel.axvline(PAPER[axis], color="black", ls="--", label="the paper's limit (Table 6)")
        panel.set_title(axis if axis != "all" else "all axes jointly")
        panel.set_xlabel(f"initial error, {_unit(axis)}")
        panel.set_ylim(0, 102)
        panel.grid(alpha=0.3)
    for panel in panels[:, 0]:
        panel.set_ylabel("% within 1 m and 1°")
    panels.flat[-1].axis("off")
    panels.flat[-1].legend(*panels.flat[1].get_legend_handles_labels(), loc="center")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def _unit(axis: str) -> str:
    return "m and °" if axis == "all" else "m" if axis in ("x", "y", "z") else "°"
