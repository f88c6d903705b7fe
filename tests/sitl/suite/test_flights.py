"""The scenario suite flown: a few on every run (embedded, and ArduPilot where it is), all if long.

The whole suite as a report: `python -m sitl suite --fc both`.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from mavlink_bridge.link.link import sleep_until
from sitl.suite import runner
from sitl.suite.case import load_cases
from sitl.suite.runner import ReportRow, run_case, run_suite
from sitl.vehicles.process import VehicleKind

CASES = load_cases()
FEW = [case for case in CASES if case.ci]
REST = [case for case in CASES if not case.ci]
KINDS = ["embedded", pytest.param("ardupilot", marks=pytest.mark.sitl)]


@cache
def flown(
    kind: VehicleKind, few: bool, watched_processors: Any
) -> tuple[dict[str, ReportRow], bool]:
    """All of them side by side, once: a flight in real time takes 0.15 of a processor.

    And whether other work took their processors.
    """
    with watched_processors() as processors:
        rows = run_suite(FEW if few else REST, [kind], jobs=len(FEW))
    return {row.case.name: row for row in rows}, processors.shared


@pytest.fixture
def check(real_time: Any, watched_processors: Any) -> Callable[[VehicleKind, str, bool], None]:
    def checked(kind: VehicleKind, name: str, few: bool) -> None:
        rows, shared = flown(kind, few, watched_processors)
        _check(rows[name], shared, real_time)

    return checked


def _check(
    row: ReportRow, shared: bool, real_time: Callable[[], AbstractContextManager[None]]
) -> None:
    """What a flight did that fell behind real time says nothing: it flies once more, alone."""
    if row.ok or not (shared or row.slow or row.error):
        assert row.ok, [f.what for f in row.findings if not f.ok]
        return
    with real_time():
        row = run_case(row.case, row.vehicle, seed=1)
        failed = row.error or [f.what for f in row.findings if not f.ok]
        if row.slow and not row.ok and row.record is not None:
            pytest.skip(f"twice too slow a machine ({row.record.pace_text}): {failed}")
        assert row.ok, failed


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", [case.name for case in FEW])
def test_scenario(check: Any, kind: VehicleKind, name: str) -> None:
    check(kind, name, few=True)


@pytest.fixture
def folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Where the workers' vehicles make their folders."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def test_an_interrupted_suite_ends_and_flies_no_more(folders: Path) -> None:
    """Each of its flights takes a minute."""
    # A shell starts what it puts into the background with the interrupt ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    interrupted: list[float] = []

    def interrupt() -> None:
        if sleep_until(lambda: any(folders.glob("embedded-*")), 300.0):  # it flies
            interrupted.append(time.monotonic())
            os.kill(os.getpid(), signal.SIGINT)

    pilot = threading.Thread(target=interrupt)
    pilot.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_suite(FEW, ["embedded"], jobs=1)
    finally:
        pilot.join()
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - interrupted[0] < 30.0 * len(FEW)
    _all_is_over(folders)


def test_a_suite_that_is_interrupted_while_it_starts_ends_too(folders, monkeypatch):
    class Interrupted(ProcessPoolExecutor):
        def submit(self, *arguments: Any, **more: Any) -> Any:
            if self._processes:
                raise KeyboardInterrupt
            return super().submit(*arguments, **more)

    monkeypatch.setattr(runner, "ProcessPoolExecutor", Interrupted)
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_suite(FEW, ["embedded"], jobs=2)
    assert time.monotonic() - start < 30.0
    _all_is_over(folders)


def _all_is_over(folders: Path) -> None:
    # Whether this thread or the pool's takes an ended worker's status first is a race.
    assert sleep_until(lambda: not multiprocessing.active_children(), 60.0)
    assert not list(folders.glob("embedded-*"))


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", [case.name for case in REST])
def test_every_other_scenario(check: Any, kind: VehicleKind, name: str) -> None:
    check(kind, name, few=False)
