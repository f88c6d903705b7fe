"""What the fixes say: errors by kind and by time of looking, the worst point, honesty."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

_CHI2_95 = {2: 5.991, 3: 7.815}


@dataclass(frozen=True)
class FixSample:
    """One reported fix. horizontal_m: of error_m; looked_s: since the target was first seen;
    elsewhere: as it was told.
    """

    thing: str
    kind: str
    looked_s: float
    error_m: float
    nees: float
    sigma_m: float
    elsewhere: float
    velocity_told: bool
    velocity_error_mps: float
    velocity_nees: float
    horizontal_m: float


def rows(samples: Iterable[FixSample], refused: int, seen: int) -> list[dict[str, object]]:
    """One line for each kind and span of looking, and what of all sightings was not reported."""
    kept, found = list(samples), []
    spans: dict[str, Callable[[float], bool]] = {
        "first": lambda s: s == 0.0, "under 5 s": lambda s: s < 5.0, "from 5 s": lambda s: s >= 5.0,
    }  # fmt: skip
    for kind in sorted({s.kind for s in kept}):
        for span, holds in spans.items():
            chosen = [s for s in kept if s.kind == kind and holds(s.looked_s)]
            if chosen:
                found.append({"kind": kind, "looked": span, **_row(chosen)})
    found.append({"kind": "all", "sightings": seen, "refused": refused})
    return found


def _row(chosen: list[FixSample]) -> dict[str, object]:
    errors = np.array([s.error_m for s in chosen])
    nees = np.array([s.nees for s in chosen])
    by_thing: dict[str, list[float]] = {}
    for s in chosen:
        by_thing.setdefault(s.thing, []).append(s.error_m)
    p95 = {name: float(np.quantile(e, 0.95)) for name, e in by_thing.items()}
    worst = max(p95, key=lambda name: p95[name])
    row: dict[str, object] = {
        "targets": len(by_thing),
        "fixes": len(chosen),
        "p50_m": float(np.quantile(errors, 0.5)),
        "p95_m": float(np.quantile(errors, 0.95)),
        "max_m": float(errors.max()),
        "worst_point": worst,
        "worst_point_p95_m": p95[worst],
        "points_above_1_m_p95": sum(e > 1.0 for e in p95.values()),
        "ce90_m": float(np.quantile([s.horizontal_m for s in chosen], 0.9)),
        "within_1_3_5_m_percent": [round(100 * float(np.mean(errors <= m)), 2) for m in (1, 3, 5)],
        "inside_95_percent": float(100 * np.mean(nees <= _CHI2_95[3])),
        "nees_mean": float(np.minimum(nees, 1e6).mean()),
        "sigma_m_p50": float(np.median([s.sigma_m for s in chosen])),
        "velocity_told_percent": float(100 * np.mean([s.velocity_told for s in chosen])),
    }
    moving = [s for s in chosen if s.velocity_told]
    if moving:
        off = np.array([s.velocity_error_mps for s in moving])
        honest = np.array([s.velocity_nees for s in moving])
        row["velocity_p50_mps"] = float(np.quantile(off, 0.5))
        row["velocity_p95_mps"] = float(np.quantile(off, 0.95))
        row["velocity_nees_mean"] = float(honest.mean())
        row["velocity_inside_95_percent"] = float(100 * np.mean(honest <= _CHI2_95[2]))
    return row
