"""Named errors for failed writes, JSON values, and non-blocking writing."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import ReportError
from localizer.map.cache.cache import INDEX_NAME
from mavlink_bridge.atomic_file import replace_file

_BY_UMASK = 0o666


@contextmanager
def writing(path: Path, option: str = "") -> Iterator[None]:
    """Context manager: an `OSError` becomes a `ReportError` with the file's name.

    option: command-line option that named the file, e.g. ``--out``; "" for none.
    """
    try:
        yield
    except OSError as error:
        where = f"{option} {path}".strip()
        raise ReportError(f"{where}: cannot be written: {error.strerror or error}") from error


def write_result(path: Path, text: str, option: str = "") -> None:
    """Write a file of text (UTF-8) as a whole: `ReportError` if that fails, and an old one stays.
    option: as in `writing`.
    """
    with writing(path, option):
        replace_file(path, text, _BY_UMASK)


def make_folder(path: Path, option: str = "") -> Path:
    """Create the folder and its parents if missing, and return it; `ReportError` if that fails or
    `path` is a file. option: as in `writing`.
    """
    if path.is_file():
        raise ReportError(f"{option} {path}: is a file; give a folder".lstrip())
    with writing(path, option):
        path.mkdir(parents=True, exist_ok=True)
    return path


def result_file(path: Path, option: str, suffixes: tuple[str, ...], *inputs: Path | None) -> Path:
    """`path`, if a result can be written there; nothing is created. `ReportError` if it has none of
    the suffixes, given as ".csv", is one of the inputs, lies in a tile cache, or is not writable.
    """
    refuse_input(path, option, *inputs)
    if path.suffix.lower() not in suffixes:
        raise ReportError(f"{option} {path}: give a file that ends in {' or '.join(suffixes)}")
    if path.exists() and not path.is_file():
        raise ReportError(f"{option} {path}: is a folder or a device; give a file's name")
    if not path.parent.is_dir():
        raise ReportError(f"{option} {path}: no such folder")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise ReportError(f"{option} {path}: may not be written; choose another place")
    return path


def refuse_input(path: Path, option: str, *inputs: Path | None) -> None:
    """`ReportError` if an output file is one of the inputs, or lies in a tile cache."""
    for given in inputs:
        if given is not None and path.exists() and given.exists() and path.samefile(given):
            raise ReportError(f"{option}: would replace {given}, which is read; give another one")
    if any((folder / INDEX_NAME).is_file() for folder in path.resolve().parents):
        raise ReportError(f"{option} {path}: lies in a tile cache; give a file beside it")


def json_value(value: Any) -> Any:
    """As JSON's own types; NaN and infinity become None."""
    if isinstance(value, dict):
        return {str(k): json_value(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


class NewestFile:
    """A file with the newest text. Its own thread replaces it atomically, so that a slow disk
    blocks no other thread. If the disk is slower than new texts come, older texts are skipped.

    failed: called in that thread with the error.
    """

    def __init__(self, path: Path, failed: Callable[[OSError], None]) -> None:
        self._path, self._failed = path, failed
        self._newest: str | None = None
        self._has_failed = self._stopping = False
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name=path.name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def put(self, text: str) -> None:
        """Set the text to write. Never blocks."""
        self._newest = text
        self._wake.set()

    def stop(self, patience_s: float = 2.0) -> None:
        """Write the last text and end; waits up to patience_s for a disk that hangs."""
        self._stopping = True
        self._wake.set()
        self._thread.join(patience_s)

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            stopping = self._stopping  # before the write: what comes in it is written next
            text, self._newest = self._newest, None
            if text is not None:
                self._write(text)
            if stopping:
                return

    def _write(self, text: str) -> None:
        try:
            replace_file(self._path, text, _BY_UMASK)
        except OSError as error:
            if not self._has_failed:
                self._failed(error)
            self._has_failed = True
