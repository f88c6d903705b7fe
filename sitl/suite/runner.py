"""Flies all scenarios, several in parallel, judges each at its end, and writes the report."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from companion.writing import write_result
from mavlink_bridge.alerts.integrity import INTEGRITY
from sitl.errors import SimulationError
from sitl.suite.case import Case
from sitl.suite.checks import AccuracyExpectation, ExpectationResult
from sitl.suite.flight import fly
from sitl.suite.record import Array, CaseRecord
from sitl.vehicles.process import VehicleKind

_COLOURS = {"pass": "green", "better": "cyan", "FAIL": "red", "ERROR": "red"}
_COLUMNS = (
    "scenario",
    "vehicle",
    "reference, m",
    "measured, m",
    "what was checked",
    "verdict",
)


def print_row(console: Console, row: ReportRow) -> None:
    """Print one flight's result."""
    colour = _COLOURS[row.verdict]
    told = row.error.splitlines()[0] if row.error else "; ".join(_broken(row))
    line = f"[{colour}]{row.verdict:6}[/] {row.vehicle} {row.case.name} ({row.wall_s:.0f} s)"
    console.print(f"{line} {escape(told)}", highlight=False)


def summary(rows: Iterable[ReportRow]) -> str:
    """Text: number of flights passed, and false alarms of the monitor."""
    rows = list(rows)
    verdicts = [row.verdict for row in rows]
    counts = (f"{verdicts.count(v)} {v}" for v in _COLOURS if v in verdicts)
    honest = [row for row in rows if row.case.is_honest and row.record is not None]
    spoke = sum(bool(row.monitor_alerts) for row in honest)
    return (
        f"{len(verdicts)} flights: {', '.join(counts)}; the monitor raised alerts in {spoke} of "
        f"{len(honest)} with honest fixes"
    )


def write_report(rows: Sequence[ReportRow], folder: Path) -> None:
    """Write suite.md and suite.json into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_result(folder / "suite.md", markdown(rows))
    text = json.dumps([_as_data(row) for row in rows], indent=1)
    write_result(folder / "suite.json", text + "\n")


def markdown(rows: Sequence[ReportRow]) -> str:
    """Markdown table; EKF errors are horizontal: median / p95 / max in metres."""
    lines = [
        "| " + " | ".join(_COLUMNS) + " |",
        "|" + "---|" * len(_COLUMNS),
        *("| " + " | ".join(c.replace("|", "/") for c in _cells(row)) + " |" for row in rows),
        "",
        summary(rows),
        "",
    ]
    return "\n".join(lines)


def _cells(row: ReportRow) -> tuple[str, ...]:
    reference = row.reference
    wanted = ""
    if reference is not None:
        wanted = _three((reference.median, reference.p95, reference.max))
    told = row.error.splitlines()[0] if row.error else "; ".join(_told(row))
    return (
        row.case.name,
        row.vehicle,
        wanted,
        _three(row.measured or ()),
        told,
        row.verdict,
    )


def _three(values: Iterable[float | None]) -> str:
    return " / ".join("-" if v is None else f"{v:.2f}" for v in values)


def _told(row: ReportRow) -> list[str]:
    return [f.what if f.ok else f"NOT: {f.what}" for f in row.findings] + _pace(row)


def _broken(row: ReportRow) -> list[str]:
    return [f.what for f in row.findings if not f.ok] + _pace(row)


def _pace(row: ReportRow) -> list[str]:
    if row.record is None or not row.slow:
        return []
    return [f"machine too slow: {row.record.pace_text}"]


def _as_data(row: ReportRow) -> dict[str, Any]:
    return {
        "scenario": row.case.name,
        "title": row.case.title,
        "vehicle": row.vehicle,
        "verdict": row.verdict,
        "honest": row.case.is_honest,
        "guardian": row.monitor_alerts,
        "error": row.error,
        "measured": row.measured,
        "findings": [asdict(f) for f in row.findings],
        "pace": None if row.record is None else round(row.record.pace, 3),
        "stall_s": None if row.record is None else round(row.record.stall_s, 3),
        "wall_s": round(row.wall_s, 1),
        "record": None if row.record is None else asdict(row.record),
    }


PACE_LIMIT = 0.98
STALL_LIMIT_S = 0.05  # on a machine with room it is below 0.01 s
_LANDING_S = 15.0  # in which an interrupted flight ends its vehicle
Figures = tuple[float, float, float]

_MONITORED = {spec.id for spec in INTEGRITY}


@dataclass(frozen=True)
class ReportRow:
    """One row of the report. record: None if the flight could not be flown; error says why."""

    case: Case
    vehicle: VehicleKind
    record: CaseRecord | None
    findings: tuple[ExpectationResult, ...]
    error: str = ""
    wall_s: float = 0.0

    @property
    def ok(self) -> bool:
        """Whether the flight was flown and every expectation holds."""
        return not self.error and all(f.ok for f in self.findings)

    @property
    def verdict(self) -> str:
        """pass; better: passes, with a median below the reference's band; FAIL; ERROR."""
        if self.error:
            return "ERROR"
        if not self.ok:
            return "FAIL"
        return "better" if any(f.better for f in self.findings) else "pass"

    @property
    def slow(self) -> bool:
        """Whether the machine could not run the vehicle in real time, which costs accuracy."""
        r = self.record
        return r is not None and (r.pace < PACE_LIMIT or r.stall_s > STALL_LIMIT_S)

    @property
    def monitor_alerts(self) -> tuple[str, ...]:
        """Alerts of the integrity monitor with their times, without the bridge's own."""
        texts = self.record.texts if self.record is not None else []
        its = [t for t in texts if t.raised is not None and t.raised[0] in _MONITORED]
        return tuple(f"{t.at_s:.1f} s: {t.text}" for t in its)

    @property
    def reference(self) -> AccuracyExpectation | None:
        """The expectation with ArduPilot's measured figures; None if the scenario has none."""
        return next((e for e in self.case.expect if isinstance(e, AccuracyExpectation)), None)

    @property
    def measured(self) -> Figures | None:
        """Median, p95 and maximum of the EKF error over the reference's span; None: not flown."""
        if self.record is None:
            return None
        span = self.reference or AccuracyExpectation(check="reference", median=1.0)
        return figures(self.record.horizontal(span.from_s, span.to_s))


def figures(errors: Array) -> Figures | None:
    """Median, 95th percentile and maximum of errors (N,), m; None for an empty array."""
    if not len(errors):
        return None
    median, p95, largest = (float(v) for v in (*np.percentile(errors, [50, 95]), errors.max()))
    return median, p95, largest


def evaluate(case: Case, record: CaseRecord) -> tuple[ExpectationResult, ...]:
    """Check every expectation of the scenario against the record."""
    return tuple(expectation.evaluate(record) for expectation in case.expect)


def run_case(case: Case, kind: VehicleKind, seed: int) -> ReportRow:
    """Fly and evaluate one scenario on one kind of vehicle. If the flight fails, the row holds the
    error's text; nothing is raised.
    """
    start = time.monotonic()
    try:
        record = fly(case, kind, seed)
    except (SimulationError, OSError) as error:
        text = f"{type(error).__name__}: {error}"
        return ReportRow(case, kind, None, (), text, time.monotonic() - start)
    return ReportRow(case, kind, record, evaluate(case, record), "", time.monotonic() - start)


def run_suite(
    cases: Iterable[Case],
    kinds: Iterable[VehicleKind],
    jobs: int | None = None,
    seed: int = 1,
    landed: Callable[[ReportRow], None] = lambda _row: None,
) -> list[ReportRow]:
    """Fly all scenarios on all vehicles, `jobs` at a time (None: `default_jobs`); rows in the order
    of the cases.

    landed: called with each row when its flight has ended.
    """
    kinds = list(kinds)
    wanted = [(case, kind) for kind in kinds for case in cases]
    # Long flights first, so that none of them is alone at the end.
    longest_first = sorted(wanted, key=lambda w: -_expected_s(w[0]))
    rows: dict[tuple[str, str], ReportRow] = {}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs or default_jobs(), context, _end_on_sigterm) as pool:
        try:
            futures = {
                pool.submit(_fly_in_worker, case, kind, seed): (case, kind)
                for case, kind in longest_first
            }
            for future in as_completed(futures):
                case, kind = futures[future]
                row = _row(future, case, kind)
                rows[case.name, kind] = row
                landed(row)
        except BaseException:  # interrupted: the flights that wait are not wanted any more
            pool.shutdown(wait=False, cancel_futures=True)
            workers = multiprocessing.active_children()
            for worker in workers:
                worker.terminate()
            for worker in workers:
                worker.join(_LANDING_S)
            raise
    return [rows[case.name, kind] for case, kind in wanted]


def _end_on_sigterm() -> None:
    # As an exception, so that a flight that is ended takes its vehicle with it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))


def _fly_in_worker(case: Case, kind: VehicleKind, seed: int) -> ReportRow:
    """`run_case`. An interruption ends the worker, which would else get the next case."""
    try:
        return run_case(case, kind, seed)
    except (KeyboardInterrupt, SystemExit):
        os._exit(128 + signal.SIGTERM)


def default_jobs() -> int:
    """Default number of parallel flights: twice the processors, as a flight uses 0.3 of one."""
    return 2 * (os.cpu_count() or 1)


def _row(future: Future[ReportRow], case: Case, kind: VehicleKind) -> ReportRow:
    try:
        return future.result()
    except BrokenProcessPool:
        return ReportRow(case, kind, None, (), "the flight's process died")
    except Exception as error:
        # One flight that breaks must not cost the report of the others.
        return ReportRow(case, kind, None, (), f"{type(error).__name__}: {error}")


def _expected_s(case: Case) -> float:
    flight = case.flight
    return flight.seconds or 4 * (flight.side_m / 10.0 + 5.0)
