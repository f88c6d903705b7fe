"""How fast an EKF drifts that gets no fix, against what the priors believe of it.

    python -m benchmarks.bridge.drift FLIGHTS [--json out.json]

FLIGHTS is a folder of flights of `python -m sitl loop` (each one's flight.json, at any depth). Of
every loss that began from a right position (2 m) and that the companion told ("localization lost
N s"), the EKF's horizontal error is held against `companion.flight.priors.drift_sigma_m`, one axis,
until the EKF reports no position any more. Of a stretch only the errors at 5, 10, 15, 20 and 30 s
count, since neighbouring ones are one error. The fit is the largest likelihood of Rayleigh's
distribution under sigma = a t + b t²; it is of simulated inertial sensors. Spoofed, dragged and
frozen flights are left out: there the EKF was fed what is wrong.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.arguments import Parser, existing, output
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from companion.flight.priors import drift_sigma_m

COLUMNS = ("after", "losses", "EKF error median, worst, m", "believed sigma, one axis, m")
AT_S = (5.0, 10.0, 15.0, 20.0, 30.0)
RIGHT_M = 2.0
_FED_WRONG = ("spoofed", "frozen", "shifted", "late", "focal", "gimbal", "other-map", "jump")
_LOST = re.compile(r"lost (\d+) s")
_NEAR_S = 1.0
_HALF_SECOND = 0.5  # the text says whole seconds
_P95 = 2.448  # of Rayleigh's distribution, in sigmas of one axis


@dataclass(frozen=True)
class Drift:
    """An EKF's horizontal error so long after the last fix. believed_m: sigma of one axis."""

    flight: str
    seconds: float
    error_m: float
    believed_m: float


@dataclass(frozen=True)
class Fit:
    """sigma = speed t + acceleration t², one axis. flights, errors: that it was fitted on;
    believed_covers: errors within the believed 95 %.
    """

    speed_m_s: float
    acceleration_m_s2: float
    flights: int
    errors: int
    believed_covers: int
    worst_over_believed: float


def stretches(samples: Sequence[dict[str, Any]]) -> Iterator[list[tuple[float, float]]]:
    """(seconds since the last fix, EKF's error) of every loss, as long as the EKF has a position:
    without one its last error stands still.
    """
    run: list[tuple[float, float]] = []
    for sample in samples:
        told = _LOST.search(str(sample["health"]))
        error = sample["error_m"]
        if told is None or error is None or not np.isfinite(error):
            if run:
                yield run
            run = []
            continue
        seconds = float(told[1]) + _HALF_SECOND
        if run and seconds < run[-1][0]:
            yield run
            run = []
        run.append((seconds, float(error)))
    if run:
        yield run


def moving(run: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """A stretch until the error stands still to the last digit."""
    for k, (before, after) in enumerate(pairwise(run)):
        if before[1] == after[1]:
            return run[: k + 1]
    return run


def drifts(name: str, samples: Sequence[dict[str, Any]]) -> list[Drift]:
    """The errors of one flight that count."""
    found = []
    for run in stretches(samples):
        if run[0][1] > RIGHT_M:
            continue
        seconds = np.array([t for t, _ in moving(run)])
        errors = [e for _, e in moving(run)]
        for at in AT_S:
            k = int(np.abs(seconds - at).argmin())
            if abs(seconds[k] - at) <= _NEAR_S:
                found.append(Drift(name, float(seconds[k]), errors[k], drift_sigma_m(seconds[k])))
    return found


def fitted(found: Sequence[Drift]) -> Fit:
    """The likeliest a and b of a grid."""
    t, error = (np.array([getattr(d, k) for d in found]) for k in ("seconds", "error_m"))
    best = (np.inf, 0.0, 0.0)
    for speed in np.linspace(0.0, 0.5, 51):
        for acceleration in np.linspace(0.0, 0.1, 101):
            sigma = speed * t + acceleration * t * t
            if sigma.min() <= 0:
                continue
            cost = float((2.0 * np.log(sigma) + 0.5 * (error / sigma) ** 2).sum())
            best = min(best, (cost, float(speed), float(acceleration)))
    ratio = error / np.array([d.believed_m for d in found])
    return Fit(
        best[1],
        best[2],
        len({d.flight for d in found}),
        len(found),
        int((ratio <= _P95).sum()),
        float(ratio.max()),
    )


def read(folder: Path) -> list[Drift]:
    """Of all flights below a folder."""
    found = []
    for path in sorted(folder.rglob("flight.json")):
        name = str(path.parent.relative_to(folder))
        if not any(word in name for word in _FED_WRONG):
            found += drifts(name, json.loads(path.read_text(encoding="utf-8"))["samples"])
    return found


def table(found: Sequence[Drift]) -> list[tuple[str, ...]]:
    """One line for each time, and one for the fit."""
    rows: list[tuple[str, ...]] = []
    for at in AT_S:
        errors = [d.error_m for d in found if abs(d.seconds - at) <= _NEAR_S]
        if errors:
            extremes = f"{np.median(errors):.1f}, {max(errors):.1f}"
            rows.append((f"{at:.0f} s", str(len(errors)), extremes, f"{drift_sigma_m(at):.1f}"))
    fit = fitted(found)
    rows.append(
        (
            f"fit: {fit.speed_m_s:.2f} t + {fit.acceleration_m_s2:.3f} t²",
            f"{fit.flights} flights, {fit.errors} errors",
            f"{fit.believed_covers} within the believed 95 %",
            f"worst {fit.worst_over_believed:.2f} sigmas",
        )
    )
    return rows


def main() -> None:
    p = Parser(__doc__)
    p.add_argument("flights", type=existing, help="folder of flights")
    p.add_argument("--json", type=output, help="the table")
    args = p.parse_args()
    found = read(args.flights)
    if not found:
        p.error(f"{args.flights}: no flight with a loss that the companion told")
    rows = table(found)
    show_figures(args.json, COLUMNS, rows)


if __name__ == "__main__":
    with named_errors():
        main()
