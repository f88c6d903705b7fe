"""What a benchmark says of bad input."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from localizer.errors import ModelError

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from named_errors import named_errors

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
COMMANDS = sorted(p for p in BENCHMARKS.glob("*.py") if '__name__ == "__main__"' in p.read_text())


@pytest.mark.parametrize("error", [ModelError("a.onnx: no"), FileNotFoundError("a.csv")])
def test_a_named_error_is_one_line(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended, named_errors():
        raise error
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"{type(error).__name__}: {error}\n"


@pytest.mark.parametrize("path", COMMANDS, ids=lambda p: p.stem)
def test_every_benchmark_does_so(path: Path) -> None:
    assert "    with named_errors():\n" in path.read_text()
