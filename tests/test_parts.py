"""The suite's two parts: who belongs where, and that neither hides the other."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.parts import COMPUTING, REAL_TIME, RUNS_ALONE, main, part_of, together

ROOT = Path(__file__).resolve().parents[1]
# What gives real time away: a vehicle in real time, the conversation with one, a machine with room.
MEETS_REAL_TIME = re.compile(
    r"EmbeddedSitl\(|FakeAutopilot|def test_\w+\([^)]*\b(?:real_time|watched_processors)\b"
)


def test_what_meets_real_time_runs_alone():
    found = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tests").rglob("test_*.py")
        if path != Path(__file__).resolve() and MEETS_REAL_TIME.search(path.read_text())
    ]
    assert len(found) >= 10
    assert [path for path in found if part_of(path) == COMPUTING] == []


@pytest.mark.parametrize("entry", RUNS_ALONE)
def test_what_runs_alone_exists(entry):
    assert (ROOT / entry).exists()
    assert part_of(entry) == REAL_TIME


@pytest.mark.parametrize(
    ("codes", "code"),
    [((0, 0), 0), ((0, 5), 0), ((5, 0), 0), ((5, 5), 5), ((1, 0), 1), ((0, 1), 1), ((5, 1), 1),
     ((2, 1), 2), ((-11, 0), -11)],
)  # fmt: skip
def test_one_exit_code(codes, code):
    assert together(codes) == code


def test_the_second_part_runs_after_a_failure_of_the_first(monkeypatch, capsys):
    codes, commands = iter([1, 0]), []

    def run(command, **_):
        commands.append(command)
        return SimpleNamespace(returncode=next(codes))

    monkeypatch.setattr("subprocess.run", run)
    assert main(["-k", "pose"]) == 1
    first, second = commands
    assert f"--part={COMPUTING}" in first
    assert f"--part={REAL_TIME}" in second
    assert "--numprocesses=2" in first
    assert "--numprocesses=2" not in second
    assert all(command[-2:] == ["-k", "pose"] for command in commands)
    assert "computing part: FAILED (1), real-time part: passed" in capsys.readouterr().out
