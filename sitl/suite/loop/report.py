"""Results of the flights as a table (failures first) and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from scipy.stats import binomtest

from companion.writing import json_value
from sitl.demo.scenario import ScenarioError
from sitl.suite.loop.evaluation import LoopExpectationResult, LoopFigures
from sitl.suite.runner import PACE_LIMIT, STALL_LIMIT_S
from sitl.vehicles.process import VehicleKind

_COLUMNS = (
    "flight", "vehicle, seed", "EKF at most, m", "unreported, s", "false of sent", "worst fix, m",
    "reported, s", "frames/s", "held",
)  # fmt: skip


@dataclass(frozen=True)
class LoopRow:
    """Result of one flight; error: why it could not be flown, otherwise empty.

    alarms: false alarms; None for a flight with a fault. pace, stall_s: see `sitl.suite.record`.
    """

    name: str
    vehicle: VehicleKind
    seed: int
    held: tuple[LoopExpectationResult, ...]
    figures: LoopFigures | None = None
    alarms: tuple[str, ...] | None = None
    pace: float = 1.0
    stall_s: float = 0.0
    error: str = ""

    @property
    def ok(self) -> bool:
        """Whether the flight was flown and every expectation holds."""
        return not self.error and all(held.ok for held in self.held)

    @property
    def valid(self) -> bool:
        """Whether it was flown, in real time."""
        return not self.error and not self.slow

    @property
    def slow(self) -> bool:
        """Whether the vehicle did not run in real time; the result then says little."""
        return self.pace < PACE_LIMIT or self.stall_s > STALL_LIMIT_S


@dataclass(frozen=True)
class FalseAlarms:
    """False-alarm statistics of flights without a fault. low, high: exact 95 % interval of the
    share of flights with an alarm (Clopper and Pearson). told_s: seconds with an alert.
    """

    flights: int
    with_alarm: int
    low: float
    high: float
    hours: float
    told_s: float


def false_alarm_rate(rows: Sequence[LoopRow]) -> FalseAlarms | None:
    """False-alarm statistics of the flown flights without a fault; None without any."""
    normal = [row for row in rows if row.alarms is not None and row.figures is not None]
    if not normal:
        return None
    n, hits = len(normal), sum(bool(row.alarms) for row in normal)
    flown = [row.figures for row in normal if row.figures is not None]
    share = binomtest(hits, n).proportion_ci()
    return FalseAlarms(
        flights=n,
        with_alarm=hits,
        low=float(share.low),
        high=float(share.high),
        hours=sum(f.seconds for f in flown) / 3600.0,
        told_s=sum(f.told_s for f in flown),
    )


def as_data(rows: Sequence[LoopRow]) -> dict[str, Any]:
    """Rows as JSON data; NaN and infinity become None."""
    rate = false_alarm_rate(rows)
    flights = [asdict(row) | {"ok": row.ok, "slow": row.slow} for row in rows]
    alarms = None if rate is None else asdict(rate)
    return {"flights": json_value(flights), "false_alarms": json_value(alarms)}


def read_rows(path: Path) -> tuple[LoopRow, ...]:
    """Read the rows of a ``loop.json``. `ScenarioError` for another file."""
    try:
        flights = json.loads(path.read_text(encoding="utf-8"))["flights"]
        return tuple(_row(flight) for flight in flights)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ScenarioError(f"{path}: not a loop.json of this version: {error}") from error


def _row(flight: dict[str, Any]) -> LoopRow:
    known = {k: v for k, v in flight.items() if k not in ("ok", "slow")}
    figures, alarms = known.pop("figures"), known.pop("alarms")
    if figures is not None:
        unknown = {k: math.nan for k, v in figures.items() if v is None}
        figures = LoopFigures(**(figures | unknown))
    known["held"] = tuple(LoopExpectationResult(**one) for one in known["held"])
    return LoopRow(**known, figures=figures, alarms=None if alarms is None else tuple(alarms))


def markdown(rows: Sequence[LoopRow]) -> str:
    """Markdown table of the flights, failed ones first, and below it the rate of false alarms if
    there were normal flights.
    """
    ordered = sorted(rows, key=lambda row: (row.ok, row.name, row.vehicle, row.seed))
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|" + "---|" * len(_COLUMNS)]
    lines += ["| " + " | ".join(_cells(row)) + " |" for row in ordered]
    rate = false_alarm_rate(rows)
    if rate is not None:
        share = f"{rate.with_alarm} of {rate.flights} normal flights with a false alarm"
        low, high = 100 * rate.low, 100 * rate.high
        lines += ["", f"{share} ({low:.0f} to {high:.0f} %, exact 95 %), {rate.told_s:.0f} s"]
        lines[-1] += f" reported of {3600 * rate.hours:.0f} s."
    return "\n".join([*lines, ""])


def print_loop_row(console: Console, row: LoopRow) -> None:
    """Print one flight's result."""
    if row.error:
        console.print(f"[red]ERROR[/] {row.name}: {escape(row.error)}", highlight=False)
    for held in row.held:
        mark = "[green]ok[/]" if held.ok else "[red]MISSED[/]"
        console.print(f"  {mark} {escape(held.what)}: {escape(held.seen)}", highlight=False)


def _cells(row: LoopRow) -> tuple[str, ...]:
    who = f"{row.vehicle}, {row.seed}" + (f" (pace {row.pace:.2f})" if row.slow else "")
    flown = row.figures
    if flown is None:
        return (row.name, who, *["-"] * 6, f"NOT FLOWN: {row.error.splitlines()[0]}")
    missed = [f"MISSED {held.what}: {held.seen}" for held in row.held if not held.ok]
    listed = [held.seen for held in row.held if held.ok and held.listed]
    return (
        row.name,
        who,
        f"{flown.max_error_m:.1f}",
        f"{flown.untold_s:.1f}",
        f"{flown.false} of {flown.sent}",
        f"{flown.max_fix_m:.1f}" if flown.sent else "-",
        f"{flown.told_s:.0f}",
        f"{flown.rate_hz:.1f}",
        "; ".join([*(missed or ["all"]), *listed]).replace("|", "/"),
    )
