import subprocess
import sys

WITHOUT_TORCH = """
import runpy, sys
sys.modules["torch"] = None
runpy.run_module("localizer.training", run_name="__main__")
"""


def test_a_machine_without_torch_is_told_in_one_line():
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH], check=False, capture_output=True, text=True
    )
    assert result.returncode == 2
    assert result.stderr.splitlines() == [
        "training needs PyTorch: pip install -e '.[train]' in the source folder"
    ]
