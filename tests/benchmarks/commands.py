"""The benchmarks that are commands."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def source(name: str) -> Path:
    """The file behind ``python -m benchmarks.NAME``."""
    path = ROOT / "benchmarks" / name.replace(".", "/")
    return path / "__main__.py" if path.is_dir() else path.with_suffix(".py")


def _name(path: Path) -> str:
    parts = path.relative_to(ROOT / "benchmarks").with_suffix("").parts
    return ".".join(part for part in parts if part != "__main__")


COMMANDS = sorted(
    _name(path)
    for path in (ROOT / "benchmarks").rglob("*.py")
    if '__name__ == "__main__"' in path.read_text()
)
