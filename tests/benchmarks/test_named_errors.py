"""What a benchmark says of bad input."""

from __future__ import annotations

import subprocess
import sys

import pytest

from benchmarks.common.named_errors import named_errors
from localizer.errors import ModelError
from tests.benchmarks.commands import ROOT


@pytest.mark.parametrize("error", [ModelError("a.onnx: no"), FileNotFoundError("a.csv")])
def test_a_named_error_is_one_line(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended, named_errors():
        raise error
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"{type(error).__name__}: {error}\n"


WITHOUT_TORCH = """
import importlib.abc, runpy, sys
class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] == "torch":
            raise ModuleNotFoundError(name, name="torch")
sys.meta_path.insert(0, Missing())
for name in sys.argv[1:]:
    sys.argv = [name, "--help"]
    try:
        runpy.run_module(f"benchmarks.{name}", run_name="__main__")
    except SystemExit as end:
        print(name, end.code)
"""
NEED_TORCH = ["integrity"]  # and others, whose other imports take seconds


def test_a_benchmark_that_needs_torch_says_so() -> None:
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, *NEED_TORCH],
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    said = "this benchmark needs PyTorch: pip install '.[train]'"
    assert run.stderr.splitlines() == [said] * len(NEED_TORCH)
    assert run.stdout.splitlines() == [f"{name} 2" for name in NEED_TORCH]
