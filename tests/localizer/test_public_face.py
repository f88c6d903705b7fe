"""`from localizer import ...`: every name is there, once, and costs nothing until it is used."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import localizer
from benchmarks.site.api import api_page

ROOT = Path(__file__).resolve().parents[2]


def test_every_public_name_is_there_and_documented():
    for name in localizer.__all__:
        value = getattr(localizer, name)
        assert value.__doc__, name
        assert not value.__doc__.startswith(f"{name}("), f"{name}: a dataclass's default docstring"
    assert set(localizer.__all__) <= set(dir(localizer))


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Locolizer'"):
        _ = localizer.Locolizer


def test_importing_the_package_imports_no_kernel_and_no_network():
    heavy = "{'numba', 'onnxruntime', 'cv2', 'scipy', 'torch'}"
    code = f"import sys, localizer; sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted in /proc")
def test_the_algebra_of_a_flight_has_no_threads_of_its_own():
    """OpenBLAS's wait in a busy loop for a core that another thread has."""
    unset = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    code = "import os, localizer, numpy; os._exit(len(os.listdir('/proc/self/task')) != 1)"
    assert subprocess.run([sys.executable, "-c", code], env=unset, check=False).returncode == 0
    timed = [sys.executable, "-X", "importtime", "-c", "from companion.cli import commands"]
    shown = subprocess.run(timed, capture_output=True, text=True, check=True).stderr
    ended = [line.split("|")[-1].strip() for line in shown.splitlines()]
    assert ended.index("localizer") < ended.index("numpy")


def test_the_page_begins_with_what_the_example_does():
    """Its ten lines are the example's, which a test runs."""
    example = (ROOT / "examples" / "localize_photo.py").read_text(encoding="utf-8")
    snippet = api_page().split("```python\n", 1)[1].split("```", 1)[0].splitlines()
    assert len(snippet) == 8
    assert [line for line in snippet[1:] if line not in example.splitlines()] == []
