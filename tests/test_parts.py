"""The suite's parts: who belongs where, and that none hides another."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.parts import (
    ALONE,
    FLIES,
    HANGS_END,
    PARTS,
    PATIENCE_S,
    RUNS_ALONE,
    SIDE_BY_SIDE,
    VEHICLES,
    WORKERS,
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


class Mypy(SimpleNamespace):
    """As it ended; `order` notes when it was waited for."""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def communicate(self):
        self.order.append("mypy")
        return b"a.py:1: error: no type\n", None


def test_the_parts_run_after_a_failure_of_the_first(monkeypatch, capsys):
    codes, commands = iter([1, 0, 0]), []
    monkeypatch.setattr("subprocess.Popen", lambda *_, **__: Mypy(returncode=0, order=[]))

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


@pytest.mark.parametrize(
    ("ends_badly", "said"),
    [
        ("ctypes.string_at(0)", "Segmentation fault"),
        ("time.sleep(600)", "Timeout"),
    ],
)
def test_a_test_that_crashes_or_hangs_is_named_and_the_run_ends(tmp_path, ends_badly, said):
    suite = f"import ctypes, time\ndef test_before(): pass\ndef test_bad(): {ends_badly}\n"
    (tmp_path / "test_bad.py").write_text(suite)
    (tmp_path / "test_good.py").write_text("def test_good(): pass\n")
    soon = [option.replace(f"={PATIENCE_S}", "=1") for option in HANGS_END]
    command = [sys.executable, "-m", "pytest", *WORKERS, *soon, "--rootdir=.", "."]
    ended = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert ended.returncode == 1
    assert "crashed while running 'test_bad.py::test_bad'" in ended.stdout
    assert said in ended.stderr


@pytest.mark.parametrize(
    ("tests", "types", "code"), [(0, 0, 0), (0, 1, 1), (0, 2, 2), (1, 0, 1), (3, 1, 3), (5, 0, 5)]
)
def test_types_are_checked_beside_the_first_part_and_told(monkeypatch, capsys, tests, types, code):
    order = []

    def run(command, **_):
        order.append(command[3])
        return SimpleNamespace(returncode=tests)

    def start(command, **_):
        order.append("started")
        assert command[-2:] == ("-m", "mypy")
        return Mypy(returncode=types, order=order)

    monkeypatch.setattr("subprocess.run", run)
    monkeypatch.setattr("subprocess.Popen", start)
    assert main([]) == code
    first, *others = [f"--part={part}" for part in PARTS]
    assert order == ["started", first, "mypy", *others]
    said = capsys.readouterr().out
    assert "a.py:1: error: no type" in said
    assert ("types: passed" in said) == (types == 0)
