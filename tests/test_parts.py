"""The suite's parts: who belongs where, and that none hides another."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.parts import (
    ALONE,
    FLIES,
    PARTS,
    RUNS_ALONE,
    SIDE_BY_SIDE,
    VEHICLES,
    main,
    part_of,
    together,
)

ROOT = Path(__file__).resolve().parents[1]
# What gives it away: a vehicle in real time, a browser, a fixture that measures the processors.
NEEDS_THE_MACHINE = re.compile(
    r"EmbeddedSitl\(|sync_playwright|def test_\w+\([^)]*\b(?:real_time|watched_processors)\b"
)


def test_what_needs_the_machine_runs_alone():
    found = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tests").rglob("test_*.py")
        if path != Path(__file__).resolve() and NEEDS_THE_MACHINE.search(path.read_text())
    ]
    assert len(found) >= 8
    assert [path for path in found if part_of(path) == SIDE_BY_SIDE] == []


@pytest.mark.parametrize(
    ("entry", "part"), [(e, VEHICLES) for e in FLIES] + [(e, ALONE) for e in RUNS_ALONE]
)
def test_what_is_listed_exists(entry, part):
    assert (ROOT / entry).exists()
    assert part_of(entry) == part


@pytest.mark.parametrize(
    ("codes", "code"),
    [((0, 0), 0), ((0, 5), 0), ((5, 0), 0), ((5, 5), 5), ((1, 0), 1), ((0, 1), 1), ((5, 1), 1),
     ((2, 1), 2), ((-11, 0), -11)],
)  # fmt: skip
def test_one_exit_code(codes, code):
    assert together(codes) == code


def test_the_parts_run_after_a_failure_of_the_first(monkeypatch, capsys):
    codes, commands = iter([1, 0, 0]), []

    def run(command, **_):
        commands.append(command)
        return SimpleNamespace(returncode=next(codes))

    monkeypatch.setattr("subprocess.run", run)
    assert main(["-k", "pose"]) == 1
    first, second, third = commands
    assert [f"--part={p}" in c for p, c in zip(PARTS, commands, strict=True)] == [True] * 3
    assert "--numprocesses=2" in first
    assert "--numprocesses=2" in second
    assert "--numprocesses=2" not in third
    assert all(command[-2:] == ["-k", "pose"] for command in commands)
    said = capsys.readouterr().out
    assert "side-by-side part: FAILED (1), vehicles part: passed, alone part: passed" in said
