"""How many positions of flights lay inside their protection level: those injected, those not."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.shares import exact_interval
from mavlink_bridge.errors import TlogError
from mavlink_bridge.link.tlog import read_tlog
from sitl.demo.scenario import ScenarioError
from sitl.suite.loop.case import LoopCase, load_loop_cases

_SENT = ("VISION_POSITION_ESTIMATE", "ODOMETRY", "GPS_INPUT")
_GAP_NS = 1_000_000_000  # between true poses, beyond which the truth is not known


@dataclass(frozen=True)
class Position:
    """One position that the localizer accepted. error_m, level_m: horizontal and vertical.
    injected: it went to the autopilot.
    """

    time_ns: int
    error_m: tuple[float, float]
    level_m: tuple[float, float]
    injected: bool


@dataclass(frozen=True)
class FlownPositions:
    """Those of one flight. normal: nothing was wrong in it."""

    name: str
    normal: bool
    positions: tuple[Position, ...]


@dataclass(frozen=True)
class Share:
    """Positions within HPL and VPL; low, high: exact 95 % interval of the horizontal share, per
    cent, as if they were independent (neighbours are not: so flights are counted, too).
    flights_whole: flights with every position inside. worst_share: largest error over its HPL.
    """

    flights: int
    flights_whole: int
    positions: int
    within_hpl: int
    within_vpl: int
    low: float
    high: float
    flights_low: float
    flights_high: float
    hpl_median_m: float
    vpl_median_m: float
    worst_share: float


def read_flight(folder: Path) -> FlownPositions:
    """A folder of `python -m sitl loop` or `demo`. RecordError says why it cannot be counted."""
    case = _case(folder)
    if case is not None and any(case.wrong.map_shift_m):
        # The world camera films a shifted ground there: its poses are no truth.
        raise TlogError(f"{folder}: the map was shifted, and frames.csv with it")
    try:
        truth = _truth(folder / "frames.csv")
        rows = [
            row for path in sorted(folder.glob("companion*/estimates.csv")) for row in _rows(path)
        ]
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise TlogError(f"{folder}: not a flight's record: {error}") from error
    sent = _sent(folder / "flight.tlog")
    found = [position for row in rows if (position := _position(row, truth, sent)) is not None]
    normal = case.is_normal if case is not None else True
    return FlownPositions(folder.name, normal, tuple(found))


def report(flights: Sequence[FlownPositions]) -> dict[str, Any]:
    """Shares by kind of flight, of injected positions and of others, and each flight's own."""
    groups = {
        "normal, injected": [f for f in flights if f.normal],
        "faults, injected": [f for f in flights if not f.normal],
        "all, injected": list(flights),
    }
    shares = {name: share(some, injected=True) for name, some in groups.items()}
    shares |= {
        name.replace("injected", "not injected"): share(some, injected=False)
        for name, some in groups.items()
    }
    return {
        "shares": {name: asdict(one) for name, one in shares.items() if one is not None},
        "flights": {
            f.name: {
                what: None if (one := share([f], injected=injected)) is None else asdict(one)
                for what, injected in (("injected", True), ("not injected", False))
            }
            for f in flights
        },
    }


def share(flights: Sequence[FlownPositions], *, injected: bool) -> Share | None:
    """Of the positions that were injected, or of those that were not; None without any."""
    counted = [[p for p in f.positions if p.injected == injected] for f in flights]
    counted = [some for some in counted if some]
    if not counted:
        return None
    errors = np.array([p.error_m for some in counted for p in some])
    levels = np.array([p.level_m for some in counted for p in some])
    inside = errors <= levels
    n, hits = len(errors), int(inside[:, 0].sum())
    whole = sum(all(p.error_m[0] <= p.level_m[0] for p in some) for some in counted)
    low, high = exact_interval(hits, n)
    flights_low, flights_high = exact_interval(whole, len(counted))
    return Share(
        len(counted), whole, n, hits, int(inside[:, 1].sum()), low, high, flights_low,
        flights_high, float(np.median(levels[:, 0])), float(np.median(levels[:, 1])),
        float((errors[:, 0] / levels[:, 0]).max()),
    )  # fmt: skip


COLUMNS = ("positions", "flights", "within HPL", "within VPL", "HPL, VPL median m", "worst / HPL")


def rows(found: dict[str, Any]) -> list[list[str]]:
    """Of `COLUMNS`, a kind of flight each."""
    return [
        [
            name,
            f"{s['flights']}, {s['flights_whole']} whole",
            f"{s['within_hpl']} of {s['positions']} [{s['low']:.2f}, {s['high']:.2f}] %",
            f"{s['within_vpl']}",
            f"{s['hpl_median_m']:.2f}, {s['vpl_median_m']:.2f}",
            f"{s['worst_share']:.2f}",
        ]
        for name, s in found["shares"].items()
    ]


def _case(folder: Path) -> LoopCase | None:
    """The flight that VEHICLE-NAME-SEED names; None of another one, as of a demo."""
    _, _, rest = folder.name.partition("-")
    name, _, seed = rest.rpartition("-")
    try:
        return load_loop_cases([name])[0] if seed.isdecimal() else None
    except ScenarioError:
        return None


def _truth(path: Path) -> np.ndarray:
    """(N, 4): time in ns and east, north, up of the camera, in the order of time."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = [
            (int(row["true_time_ns"]), *(float(row[k]) for k in ("east_m", "north_m", "up_m")))
            for row in csv.DictReader(file)
        ]
    poses = {int(row[0]): row for row in rows}
    return np.array([poses[time_ns] for time_ns in sorted(poses)], dtype=np.float64)


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _sent(path: Path) -> frozenset[int]:
    """Time stamps of the positions that went to the autopilot, microseconds."""
    stamps: set[int] = set()
    for _, message in read_tlog(path):
        if message.get_type() in _SENT:
            kind = message.get_type()
            stamps.add(int(message.usec if kind == _SENT[0] else message.time_usec))
    return frozenset(stamps)


def _position(row: dict[str, str], truth: np.ndarray, sent: frozenset[int]) -> Position | None:
    """None where it was refused, has no level, or no truth was seen about its time."""
    if row["accepted"] != "1" or not row.get("hpl_m"):
        return None
    time_ns = int(row["exposure_time_ns"])
    # Differences first: nanoseconds since boot do not fit a float's digits for long.
    since = truth[:, 0] - float(time_ns)
    after = int(np.searchsorted(since, 0.0))
    if not 0 < after < len(since) or since[after] - since[after - 1] > _GAP_NS:
        return None
    t = -since[after - 1] / (since[after] - since[after - 1])
    true = truth[after - 1, 1:] + t * (truth[after, 1:] - truth[after - 1, 1:])
    east, north, up = np.array([float(row[k]) for k in ("east_m", "north_m", "up_m")]) - true
    error = (float(np.hypot(east, north)), abs(float(up)))
    level = (float(row["hpl_m"]), float(row["vpl_m"]))
    return Position(time_ns, error, level, time_ns // 1000 in sent)
