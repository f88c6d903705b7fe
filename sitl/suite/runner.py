"""Flies all scenarios, several in parallel, and judges each at its end."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

import numpy as np

from mavlink_bridge.alerts.integrity import INTEGRITY
from sitl.errors import SimulationError
from sitl.suite.case import Case
from sitl.suite.checks import AccuracyExpectation, ExpectationResult
from sitl.suite.flight import fly
from sitl.suite.record import Array, CaseRecord
from sitl.vehicles.process import VehicleKind

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
