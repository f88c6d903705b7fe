"""Recorded flights through the monitor of now: what it would tell and withhold.

The fixes are those of estimates.csv, handed over when they came; the vehicle is the flight.tlog.
The pictures are not recorded, so the checks of them, and of the calibration, do not run.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from companion.conversions import camera_on_body
from companion.flight.injection import JumpCounter
from companion.integrity_monitor.checks import IntegrityChecks, IntegrityLimits
from companion.integrity_monitor.config import IntegrityMonitorConfig
from companion.integrity_monitor.protection import budget
from localizer.geometry.geo import NED_FROM_ENU
from localizer.geometry.pose import matrix_from_quaternion, quaternion_from_matrix
from localizer.types import TrackingState
from mavlink_bridge.errors import TlogError
from mavlink_bridge.link.tlog import read_tlog
from mavlink_bridge.messages import (
    Attitude,
    GimbalAttitude,
    InertialSample,
    VehicleState,
    VisionFix,
)
from mavlink_bridge.vehicle.tracker import VehicleTracker

_STEP_NS = 100_000_000
_LOST_EVERY_S = 20.0
_SOURCES = ("noise", "map", "calibration", "time")
_COLUMNS = (
    "flight", "fixes", "withheld", "told", "HPL median, m", "noise, map, calibration, time, %",
)  # fmt: skip


@dataclass(frozen=True)
class Replayed:
    """One flight. told: how often each finding, by name. hpl_m: the median level of what passed;
    shares: of its square, by source, medians; widened: fixes whose level is wider than its budget.
    """

    flight: str
    fixes: int
    held: int
    widened: int
    told: dict[str, int]
    hpl_m: float
    shares: dict[str, float]


@dataclass(frozen=True)
class _Arrival:
    """A fix, when it came, and how its camera looked: (3, 3) to NED; None where not recorded."""

    came_ns: int
    fix: VisionFix
    ned_from_camera: np.ndarray | None

    def with_heading(self, attitude: Attitude | None, gimbal: GimbalAttitude | None) -> VisionFix:
        """As the companion had it."""
        if self.ned_from_camera is None or attitude is None or gimbal is None:
            return self.fix
        ned_from_body = self.ned_from_camera @ camera_on_body(attitude, gimbal).T
        w, x, y, z = (float(one) for one in quaternion_from_matrix(ned_from_body))
        return replace(self.fix, quaternion=(w, x, y, z))


class _Recorded:
    """The vehicle as the record has it at a time."""

    def __init__(self) -> None:
        self.tracker = VehicleTracker(None, (1.0, 0.0, 0.0, 0.0), fixed_camera=False)
        self.now_ns = 0

    def state(self) -> VehicleState:
        return self.tracker.snapshot(self.now_ns)

    def attitude_at(self, time_ns: int) -> Attitude | None:
        return self.tracker.attitude_at(time_ns)

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        return self.tracker.gimbal_at(time_ns)

    def inertial_since(self, time_ns: int) -> tuple[InertialSample, ...]:
        return self.tracker.inertial_since(time_ns)

    def gnss_place_at(self, _time_ns: int) -> tuple[float, ...] | None:
        return None  # the calibration watch does not run


def replay(
    folder: Path, config: IntegrityMonitorConfig | None = None, lost_s: float = 0.0
) -> Replayed:
    """A folder of `python -m sitl loop` or `demo`. RecordError says why it cannot be replayed.

    lost_s: so long after each `_LOST_EVERY_S` no fix came, and the next one announces itself.
    """
    config = config or IntegrityMonitorConfig()
    try:
        arrivals, since_utc_ns = _fixes(folder)
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise TlogError(f"{folder}: not a flight's record: {error!r}") from error
    if not arrivals:
        raise TlogError(f"{folder}: no estimate in it has a protection level")
    arrivals = _without(arrivals, lost_s)
    vehicle, monitor = _Recorded(), IntegrityChecks(config, IntegrityLimits())
    told: Counter[str] = Counter()
    levels, parts = [], []
    waiting, step_ns = iter(arrivals), None
    due = next(waiting, None)
    for utc_ns, message in read_tlog(folder / "flight.tlog"):
        now_ns = utc_ns + since_utc_ns
        step_ns = now_ns if step_ns is None else step_ns
        while min(step_ns, step_ns if due is None else due.came_ns) <= now_ns:
            if due is not None and due.came_ns <= step_ns:
                vehicle.now_ns = due.came_ns
                state, attitude = vehicle.state(), vehicle.attitude_at(due.fix.time_ns)
                fix = due.with_heading(attitude, vehicle.gimbal_at(due.fix.time_ns))
                admitted = monitor.admit(fix, state, attitude)
                if admitted is not None and admitted.protection_m is not None:
                    levels.append(admitted.protection_m[0])
                    parts.append(_parts(fix, state, config))
                due = next(waiting, None)
            else:
                vehicle.now_ns = step_ns
                alerts = monitor.step(vehicle.now_ns, vehicle)
                told.update(alert.id.value for alert in alerts if alert.active)
                step_ns += _STEP_NS
        if vehicle.tracker.accepts(message):
            vehicle.tracker.handle(message, now_ns)
    return _counted(folder.name, len(arrivals), told, np.array(levels), np.array(parts))


def report(flights: Sequence[Replayed]) -> dict[str, Any]:
    """Each flight's, and all together."""
    fixes, held = sum(f.fixes for f in flights), sum(f.held for f in flights)
    rows = [_row(f) for f in flights]
    quiet = sum(not f.told and not f.held for f in flights)
    rows.append((f"{len(flights)} flights, {quiet} quiet", str(fixes), str(held), "", "", ""))
    return {"replayed": [asdict(f) for f in flights], "columns": _COLUMNS, "rows": rows}


def _counted(
    name: str, fixes: int, told: Counter[str], levels: np.ndarray, parts: np.ndarray
) -> Replayed:
    if not len(levels):
        return Replayed(name, fixes, fixes, 0, dict(told), 0.0, {})
    known = np.sqrt((parts**2).sum(axis=1))
    shares = np.median((parts / known[:, None]) ** 2, axis=0)
    return Replayed(
        name, fixes, fixes - len(levels), int((levels > known + 0.01).sum()), dict(told),
        float(np.median(levels)), dict(zip(_SOURCES, map(float, shares), strict=True)),
    )  # fmt: skip


def _parts(
    fix: VisionFix, state: VehicleState, config: IntegrityMonitorConfig
) -> tuple[float, ...]:
    """What each source alone makes of a level, metres."""
    p = config.protection
    none = p.model_copy(
        update={"map_m": 0.0, "map_height_m": 0.0, "calibration_share": 0.0, "time_bias_s": 0.0}
    )
    north, east, _ = state.local_velocity_ned or (0.0, 0.0, 0.0)
    height, speed = max(state.altitude_relative_m or 0.0, 0.0), float(np.hypot(north, east))
    alone = (
        none,
        none.model_copy(update={"map_m": p.map_m}),
        none.model_copy(update={"calibration_share": p.calibration_share}),
        none.model_copy(update={"time_bias_s": p.time_bias_s}),
    )
    sigmas = (fix.horizontal_sigma_m, 0.0, 0.0, 0.0)
    return tuple(
        budget((s, 0.0), height, (speed, 0.0), one)[0] for s, one in zip(sigmas, alone, strict=True)
    )


def _row(flight: Replayed) -> tuple[str, ...]:
    told = ", ".join(f"{name} {count}" for name, count in flight.told.items())
    shares = ", ".join(f"{100 * share:.0f}" for share in flight.shares.values())
    return (
        flight.flight, str(flight.fixes), str(flight.held), told or "-",
        f"{flight.hpl_m:.2f}", shares,
    )  # fmt: skip


def _without(arrivals: list[_Arrival], lost_s: float) -> list[_Arrival]:
    """Those that come where one is lost again and again; after each time the estimate jumped."""
    kept: list[_Arrival] = []
    losses = 0
    began_ns = arrivals[0].fix.time_ns
    for one in arrivals:
        at_s = (one.fix.time_ns - began_ns) * 1e-9 % (_LOST_EVERY_S + lost_s)
        if at_s < _LOST_EVERY_S:
            gap_s = (one.fix.time_ns - kept[-1].fix.time_ns) * 1e-9 if kept else 0.0
            losses += 0.0 < lost_s <= gap_s
            count = one.fix.reset_count + losses
            kept.append(replace(one, fix=replace(one.fix, reset_count=count)))
    return kept


def _fixes(folder: Path) -> tuple[list[_Arrival], int]:
    """The fixes as they came; and CLOCK_MONOTONIC less UTC, ns."""
    records = sorted(p.parent for p in folder.glob("companion*/estimates.csv"))
    made = json.loads((records[0] / "record.json").read_text(encoding="utf-8")) if records else {}
    jumps, fixes = JumpCounter(), []
    for record in records:
        for row in _rows(record / "estimates.csv"):
            jumps.add_state(TrackingState(row["state"]))
            if row["accepted"] == "1" and row.get("hpl_m"):
                time_ns = int(row["exposure_time_ns"])
                came_ns = time_ns + round(float(row["latency_ms"]) * 1e6)
                fix = _fix(row, time_ns, jumps.count)
                fixes.append(_Arrival(came_ns, fix, _ned_from_camera(row)))
    fixes.sort(key=lambda one: one.came_ns)
    return fixes, int(made.get("monotonic_ns", 0)) - int(made.get("utc_ns", 0))


def _ned_from_camera(row: dict[str, str]) -> np.ndarray | None:
    """Records of before 2026-11 have no rotation in this file. About the map's origin's axes."""
    if not row.get("qw"):
        return None
    w, x, y, z = (float(row[name]) for name in ("qw", "qx", "qy", "qz"))
    rotation: np.ndarray = NED_FROM_ENU @ matrix_from_quaternion((w, x, y, z))
    return rotation


def _fix(row: dict[str, str], time_ns: int, reset_count: int) -> VisionFix:
    sigmas = [float(row[f"sigma_{axis}_m"]) for axis in ("north", "east", "up")]
    covariance = np.diag(np.square(sigmas))
    return VisionFix(
        time_ns,
        float(row["latitude_deg"]),
        float(row["longitude_deg"]),
        float(row["height_m"]),
        position_covariance_ned=covariance,
        attitude_sigma_rad=float(row.get("sigma_rotation_rad") or 0.02),
        reset_count=reset_count,
    )


def _rows(path: Path) -> Iterator[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        yield from csv.DictReader(file)
