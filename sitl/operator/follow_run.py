"""Flies car-following flights one after the other and evaluates them; results are kept as JSON."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from companion.offline.tables import read_columns
from companion.targets.detections import clicked_name
from companion.writing import write_result
from sitl.demo.budget import draw_errors
from sitl.errors import SimulationError
from sitl.operator.followed import FollowedFix, FollowVerdict, follow_verdict
from sitl.operator.pursuer import LATE_S, LATE_SIGMA_S, SECONDS, Pursuer
from sitl.suite.loop.case import LoopCase
from sitl.suite.loop.flight import fly
from sitl.suite.loop.runner import RunOptions, loop_assets
from sitl.vehicles.process import VehicleKind

HEIGHT_M = 90.0
# Honest, over a world in which a minute of road is free.
FLIGHT = LoopCase(
    name="follow",
    title="a car is followed through two occlusions",
    height_m=HEIGHT_M,
    seconds=SECONDS,
    size_m=1600,
    hover=True,
    honest=True,
    deployment={
        "targets": {
            "operator_delay_ms": 1e3 * LATE_S,
            "operator_delay_sigma_ms": 1e3 * LATE_SIGMA_S,
        },
        # Every picture: what was seen of a car that is lost can be looked at again.
        "record": {"snapshot_interval_s": 0.001},
    },
)


@dataclass(frozen=True)
class FollowRow:
    """Result of one flight; error: why it could not be flown."""

    vehicle: VehicleKind
    seed: int
    draw: int
    verdict: FollowVerdict | None = None
    error: str = ""
    pace: float = 1.0
    stall_s: float = 0.0
    late_s: float = 0.0
    """From the picture's exposure to the click."""
    begin_ns: int = 0
    """When the car was where it is clicked at, CLOCK_MONOTONIC."""

    @property
    def ok(self) -> bool:
        """Whether the flight was flown and the car was tracked."""
        return self.verdict is not None and self.verdict.is_followed


def fly_follows(options: RunOptions, world: int) -> tuple[FollowRow, ...]:
    """Fly a car-following flight on each vehicle with each of `options.seeds`, which draw car and
    errors; results are written to ``out/follow.json`` after each. world: seed of the world.
    """
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[FollowRow] = []
    for kind, draw in product(options.vehicles, options.seeds):
        options.say(f"following a car on {kind}, world {world}, draw {draw}")
        rows.append(_flown(kind, draw, options, world))
        text = json.dumps([asdict(row) for row in rows], indent=1, default=str)
        write_result(options.out / "follow.json", text)
        options.say(line_of(rows[-1]))
    return tuple(rows)


def _flown(kind: VehicleKind, draw: int, options: RunOptions, seed: int) -> FollowRow:
    assets = loop_assets(FLIGHT, seed, options.worlds, options.building)
    folder = options.out / f"{kind}-{seed}-{draw}"
    shutil.rmtree(folder, ignore_errors=True)
    camera = draw_errors(FLIGHT.scenario, draw).camera
    pursuer = Pursuer(assets.world, camera, HEIGHT_M, draw)
    try:
        record = fly(FLIGHT, assets, kind, draw, folder, pursuer)
    except SimulationError as error:
        return FollowRow(kind, seed, draw, error=f"{type(error).__name__}: {error}")
    assert pursuer.chase is not None
    targets = folder / "companion" / "targets.csv"
    fixes = read_fixes(targets, pursuer.number) if targets.exists() else []
    verdict = follow_verdict(fixes, pursuer.chase, pursuer.end_ns)
    if pursuer.failure:
        verdict = replace(verdict, is_followed=False, why=(pursuer.failure, *verdict.why))
    begin_ns = pursuer.chase.begins_ns()
    return FollowRow(
        kind, seed, draw, verdict, "", record.pace, record.stall_s, pursuer.late_s, begin_ns
    )


def read_fixes(targets: Path, number: int) -> list[FollowedFix]:
    """Positions of one clicked target in ``targets.csv``."""
    table = read_columns(targets, ("target_id", "visibility"))
    rows = np.flatnonzero(np.asarray(table.get("target_id", [])) == clicked_name(number))
    return [_fix(table, int(k)) for k in rows]


def _fix(table: dict[str, np.ndarray], k: int) -> FollowedFix:
    ee, en, eu, nn, nu, uu = (table[f"cov_{c}"][k] for c in ("ee", "en", "eu", "nn", "nu", "uu"))
    velocity = np.array([table[f"velocity_{a}"][k] for a in ("east", "north", "up")])
    return FollowedFix(
        int(table["exposure_time_ns"][k]),
        np.array([table[f"{a}_m"][k] for a in ("east", "north", "up")]),
        np.array([[ee, en, eu], [en, nn, nu], [eu, nu, uu]]),
        velocity if np.isfinite(velocity).all() else None,
        str(table["visibility"][k]) == "seen",
    )


def line_of(row: FollowRow) -> str:
    """One-line result of a flight."""
    head = f"{row.vehicle}, world {row.seed}, draw {row.draw}: "
    if row.verdict is None:
        return head + f"not flown: {row.error}"
    v = row.verdict
    told = "; ".join(v.why) or "followed"
    return (
        f"{head}{told} (seen in {v.seen} of {v.reports} reports, p95 {v.p95_m:.2f} m, at most "
        f"{v.max_m:.2f} m, {v.inside_percent:.0f} % inside, back after a roof "
        f"{', '.join(f'{b:.1f}' for b in v.back_s)} s)"
    )
