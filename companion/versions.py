"""Versions for reports: of this package, Python and relevant dependencies; the commit of a
checkout; the processor.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ("pilot-companion", "numpy", "numba", "onnxruntime", "openvino",
             "opencv-python-headless", "av", "pymavlink")  # fmt: skip


def versions() -> dict[str, str]:
    """Version of Python and of each package that affects results, and the machine type; packages
    that are not installed are left out.
    """
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def made_by() -> dict[str, str]:
    """Versions, processor and, in a checkout, the commit: the origin of a figure."""
    commit = checkout()
    return versions() | {"processor": processor()} | ({"commit": commit} if commit else {})


def processor() -> str:
    """Number and name of the processors."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    named = re.search(r"^(?:model name|Model)\s*: (.+)$", text, re.M)
    name = named.group(1).strip() if named else platform.machine()
    return f"{os.cpu_count()} x {name}"


def checkout() -> str:
    """The checkout's commit, with `+` if files differ from it; "" if installed or without git."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=8", "--dirty=+"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=5.0)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()
