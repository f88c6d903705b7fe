"""Versions for reports: of this package, of Python, and of what the numbers depend on."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

_PACKAGES = ("pilot-companion", "numpy", "numba", "onnxruntime", "opencv-python-headless", "av",
             "pymavlink")  # fmt: skip


def versions() -> dict[str, str]:
    """Package name to version; a package that is not installed is left out."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
