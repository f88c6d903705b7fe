"""What a disk does not take, as a named error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from companion.errors import ReportError


@contextmanager
def writing(path: Path, option: str = "") -> Iterator[None]:
    """Around the writing of a file or folder: an `OSError` becomes a `ReportError` that names it.

    option: through which it was asked for, e.g. ``--out``.
    """
    try:
        yield
    except OSError as error:
        where = f"{option} {path}".strip()
        raise ReportError(f"{where}: cannot be written: {error.strerror or error}") from error


def made_folder(path: Path, option: str = "") -> Path:
    """The folder, made where it is missing. `ReportError` where it cannot be."""
    with writing(path, option):
        path.mkdir(parents=True, exist_ok=True)
    return path
