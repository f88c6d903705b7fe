"""`from localizer import ...`: every name is there, once, and costs nothing until it is used."""

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


def test_the_page_begins_with_what_the_example_does():
    """Its ten lines are the example's, which a test runs."""
    example = (ROOT / "examples" / "localize_photo.py").read_text(encoding="utf-8")
    snippet = api_page().split("```python\n", 1)[1].split("```", 1)[0].splitlines()
    assert len(snippet) == 8
    assert [line for line in snippet[1:] if line not in example.splitlines()] == []
