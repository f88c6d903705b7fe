"""Flies car-following flights one after the other and evaluates them; results are kept as JSON."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from companion.offline.record import read_columns
from companion.targets.detections import clicked_name
from companion.writing import write_result
from localizer.geometry.pose import Array
from sitl.demo.scenario import draw_errors
from sitl.errors import SimulationError
from sitl.operator.pursuer import LATE_S, LATE_SIGMA_S, SECONDS, Chase, Pursuer
from sitl.suite.loop.case import LoopCase
from sitl.suite.loop.flight import fly
from sitl.suite.loop.runner import RunOptions, loop_assets
from sitl.vehicles.process import VehicleKind

_LAST_S = 2.0  # before the end: it must still be seen then
_OFF_M = 4.0  # what is farther from the car's middle is no report of it
_BACK_S = 2.5  # after a roof it must be seen again so soon
_SETTLED_S = 3.0  # after the click its motion is measured


@dataclass(frozen=True)
class FollowedFix:
    """One reported target position (3,) m, map ENU, with covariance and velocity (3,) m/s or None.
    is_seen: detected in its frame, not predicted.
    """

    time_ns: int
    position: Array
    covariance: Array
    velocity: Array | None
    is_seen: bool


@dataclass(frozen=True)
class FollowVerdict:
    """Result of a target track. Errors: horizontal, of detected positions after settling. seen:
    detected positions among `reports`. back_s: time to reacquire after each roof. foreign:
    positions farther than 4 m from the car. inside_percent: within their 95 % ellipse. why: reasons
    for a failure.
    """

    is_followed: bool
    reports: int
    seen: int
    back_s: tuple[float, ...]
    foreign: int
    p50_m: float
    p95_m: float
    max_m: float
    inside_percent: float
    velocity_p95_mps: float
    why: tuple[str, ...] = ()
    errors_m: tuple[float, ...] = ()
    times_s: tuple[float, ...] = ()


_CHI2_95 = 5.991  # of two degrees of freedom


def follow_verdict(fixes: Sequence[FollowedFix], chase: Chase, end_ns: int) -> FollowVerdict:
    """Compare one target's positions with the true car, from the click until `end_ns`."""
    begin_ns = chase.begins_ns()
    off = np.array([(f.position - chase.car.position_at(f.time_ns))[:2] for f in fixes])
    off = off.reshape(-1, 2)
    errors = np.linalg.norm(off, axis=1)
    times = np.array([(f.time_ns - begin_ns) * 1e-9 for f in fixes])
    seen = np.array([f.is_seen for f in fixes], dtype=bool)
    is_own = seen & (errors <= _OFF_M)
    settled = seen & (times >= _SETTLED_S)
    nees = np.array([_nees(o, f.covariance) for o, f in zip(off, fixes, strict=True)])
    back = [_back_s(times[is_own], (b - begin_ns) * 1e-9) for _, b in chase.hidden_ns()
            if b < end_ns]  # fmt: skip
    last_s = float(times[is_own].max()) if is_own.any() else 0.0
    until_s = (end_ns - begin_ns) * 1e-9
    why = []
    if until_s - last_s > _LAST_S:
        why.append(f"last seen {last_s:.1f} s after the click, of {until_s:.0f}")
    why += [f"found {b:.1f} s after a roof" for b in back if b > _BACK_S]
    foreign = int((seen & (errors > _OFF_M)).sum())
    if foreign:
        why.append(f"{foreign} reports are of something else")
    speeds = _velocities(fixes, chase, settled)
    return FollowVerdict(
        not why, len(fixes), int(seen.sum()), tuple(back), foreign, *_spread(errors[settled]),
        _share(nees[settled]), float(np.quantile(speeds, 0.95)) if len(speeds) else float("nan"),
        tuple(why),
        tuple(float(e) for e in errors), tuple(float(t) for t in times),
    )  # fmt: skip


def _velocities(fixes: Sequence[FollowedFix], chase: Chase, chosen: NDArray[np.bool_]) -> Array:
    """Errors of the horizontal velocity (m/s) of the chosen positions that have one."""
    off = [
        np.linalg.norm((fix.velocity - chase.car.velocity_at(fix.time_ns))[:2])
        for fix, is_chosen in zip(fixes, chosen, strict=True)
        if is_chosen and fix.velocity is not None
    ]
    return np.array(off)


def _nees(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance[:2, :2], error))


def _back_s(times: Array, end_s: float) -> float:
    """Seconds from a roof's end to the first correct detection after it; infinite if there is none.
    times: of correct detections.
    """
    after = times[times >= end_s]
    return float(after.min() - end_s) if len(after) else float("inf")


def _spread(errors: Array) -> tuple[float, float, float]:
    if not len(errors):
        return (float("nan"),) * 3
    p50, p95 = np.quantile(errors, [0.5, 0.95])
    return float(p50), float(p95), float(errors.max())


def _share(nees: Array) -> float:
    return 100.0 * float(np.mean(nees <= _CHI2_95)) if len(nees) else float("nan")


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
