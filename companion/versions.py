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

_CPUINFO, _BOARD = Path("/proc/cpuinfo"), Path("/proc/device-tree/model")
_SIMD = r"\b(?:avx2|avx512(?:f|_vnni|_bf16)|avx_vnni|amx_\w+|asimd\w*|i8mm|bf16|sve\w*)\b"


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
    """Origin of a figure: versions, processor, its instructions and, in a checkout, the commit."""
    commit, computer = checkout(), {"processor": processor(), "instructions": instructions()}
    return versions() | computer | ({"commit": commit} if commit else {})


def processor() -> str:
    """Number and name of the processors, or of the board."""
    named = re.search(r"^(?:model name|Model)\s*: (.+)$", _system(_CPUINFO), re.M)
    name = named.group(1) if named else _system(_BOARD).rstrip("\0") or platform.machine()
    return f"{os.cpu_count()} x {name.strip()}"


def instructions() -> str:
    """The processor's SIMD and matrix instructions, as the system names them."""
    flags = re.search(r"^(?:flags|Features)\s*: (.+)$", _system(_CPUINFO), re.M)
    return " ".join(re.findall(_SIMD, flags.group(1))) if flags else ""


def _system(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


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
