"""What a benchmark says of arguments that make no sense."""

from __future__ import annotations

import runpy
import sys
from itertools import pairwise

import pytest

from benchmarks.common.named_errors import named_errors
from localizer.errors import ModelError
from tests.benchmarks.commands import COMMANDS


def refused(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    """What the command line writes before it ends with exit code 2."""
    name, *arguments = command.split()
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    for loaded in (f"benchmarks.{name}", f"benchmarks.{name}.__main__"):  # runpy would warn
        monkeypatch.delitem(sys.modules, loaded, raising=False)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(f"benchmarks.{name}", run_name="__main__")
    assert ended.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ("features --pairs 0", "--pairs"),
        ("features --real /no/such/set", "/no/such/set"),
        ("features --report /no/such.csv", "/no/such.csv"),
        ("features --models /no/such.onnx", "/no/such.onnx"),
        ("features --out /no/such/folder/a.csv", "/no/such/folder"),
        ("features.network_speed --count 0", "--count"),
        ("bridge --seconds nan", "--seconds"),
        ("bridge --load", "--load"),
        ("rendering --size 512", "--size"),
        ("rendering --triangles inf", "--triangles"),
        ("basin ablation . --set nowhere", "nowhere"),
        ("basin axes . --processes 0", "--processes"),
        ("gpu_checklist --map /no/such/cache", "/no/such/cache"),
        ("gpu_checklist --minutes -1", "--minutes"),
        ("places run . --frames 301", "--frames"),
        ("places table . --plot /no/such/folder/a.png", "/no/such/folder"),
        ("targets 0 --height 5", "--height"),
        ("throughput run . --widths 0", "--widths"),
        ("throughput.boards /no/such.json", "/no/such.json"),
        ("targets.by_height /no/such.json", "/no/such.json"),
    ],
)
def test_it_is_one_line(command, named, monkeypatch, capsys):
    said = refused(command, monkeypatch, capsys)
    assert named in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_explained(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    for loaded in (f"benchmarks.{name}", f"benchmarks.{name}.__main__"):  # runpy would warn
        monkeypatch.delitem(sys.modules, loaded, raising=False)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(f"benchmarks.{name}", run_name="__main__")
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert f"python -m benchmarks.{name}" in text
    options = text.partition("options:")[2].splitlines()
    alone = [
        line.strip() for line in options if line.startswith("  -") and "  " not in line.strip()
    ]
    explained = [a.strip() for a, b in pairwise(options) if b.startswith("      ")]
    assert not set(alone) - set(explained)


# --- What a benchmark says of bad input ---------------------------------------------------------


@pytest.mark.parametrize("error", [ModelError("a.onnx: no"), FileNotFoundError("a.csv")])
def test_a_named_error_is_one_line(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended, named_errors():
        raise error
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"{type(error).__name__}: {error}\n"
