"""What a benchmark says of arguments that make no sense."""

from __future__ import annotations

import runpy
import sys
from itertools import pairwise
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

COMMANDS = sorted(p for p in BENCHMARKS.glob("*.py") if '__name__ == "__main__"' in p.read_text())


def refused(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    """What the command line writes before it ends with exit code 2."""
    name, *arguments = command.split()
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(BENCHMARKS / name), run_name="__main__")
    assert ended.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ("features.py --pairs 0", "--pairs"),
        ("features.py --pairs -5", "--pairs"),
        ("features.py --pairs 1e9", "--pairs"),
        ("features.py --seed -1", "--seed"),
        ("features.py --anchors 0", "--anchors"),
        ("features.py --real /no/such/set", "/no/such/set"),
        ("features.py --report /no/such.csv", "/no/such.csv"),
        ("features.py --models /no/such.onnx", "/no/such.onnx"),
        ("features.py --out /no/such/folder/a.csv", "/no/such/folder"),
        ("features.py --mesh --real .", "--mesh"),
        ("network_speed.py --count 0", "--count"),
        ("network_speed.py --s0 /no/such.onnx", "/no/such.onnx"),
        ("bridge.py --seconds 0", "--seconds"),
        ("bridge.py --seconds nan", "--seconds"),
        ("bridge.py --load", "--load"),
        ("bridge.py --load -1", "--load"),
        ("soak.py --minutes 0", "--minutes"),
        ("soak.py --plot /no/such/folder/a.png", "/no/such/folder"),
        ("rendering.py --size 512", "--size"),
        ("rendering.py --size 0x4", "--size"),
        ("rendering.py --frames 0", "--frames"),
        ("rendering.py --triangles inf", "--triangles"),
        ("map_streaming.py --km 0", "--km"),
        ("map_streaming.py --seconds -1", "--seconds"),
        ("optimizer.py --threads 0", "--threads"),
        ("basin.py ablation . --set nowhere", "nowhere"),
        ("basin.py ablation . --pairs 0", "--pairs"),
        ("basin.py axes . --processes 0", "--processes"),
        ("basin.py priors . --starts", "--starts"),
        ("gpu_checklist.py --map /no/such/cache", "/no/such/cache"),
        ("gpu_checklist.py --minutes -1", "--minutes"),
    ],
)
def test_it_is_one_line(
    command: str, named: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(command, monkeypatch, capsys)
    assert named in said
    assert said.count("\n") == 1


def test_so_it_is_of_the_training_pairs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    for command in ("pairs.py /no/such.yaml", f"pairs.py {BENCHMARKS}/pairs.py --pairs 0"):
        assert refused(command, monkeypatch, capsys).count("\n") == 1


@pytest.mark.parametrize("path", COMMANDS, ids=lambda p: p.stem)
def test_every_option_is_explained(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if path.stem == "pairs":
        pytest.importorskip("torch")
    monkeypatch.setattr(sys, "argv", [path.name, "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(path), run_name="__main__")
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert f"python benchmarks/{path.name}" in text
    options = text.partition("options:")[2].splitlines()
    alone = [
        line.strip() for line in options if line.startswith("  -") and "  " not in line.strip()
    ]
    explained = [a.strip() for a, b in pairwise(options) if b.startswith("      ")]
    assert not set(alone) - set(explained)
