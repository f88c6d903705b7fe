"""Locks a cache folder while a program streams it, so that no build replaces it.

It is a kernel lock, which ends with the process and also works for read-only caches. On file
systems without such locks it has no effect.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from fcntl import LOCK_EX, LOCK_NB, LOCK_SH, flock
from pathlib import Path

from localizer.errors import MapCacheError


class CacheLock:
    """Lock that prevents a replacement of the cache at `path` until `close`. Any number of readers
    may have it at once. `MapCacheError` if it is just being replaced, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._folder: int | None = _opened(path)
        try:
            _lock(self._folder, LOCK_SH)
        except BlockingIOError as error:
            self.close()
            raise MapCacheError(f"{path}: is just being replaced; open it again") from error

    def close(self) -> None:
        """Release the lock."""
        if self._folder is not None:
            os.close(self._folder)
            self._folder = None


@contextmanager
def replacing(path: Path) -> Iterator[None]:
    """Context manager: lock the cache at `path` for a replacement; `MapCacheError` if in use.
    Nothing is locked if `path` does not exist.
    """
    if not path.exists():
        yield
        return
    folder = _opened(path)
    try:
        try:
            _lock(folder, LOCK_EX)
        except BlockingIOError as error:
            raise MapCacheError(
                f"{path}: is not replaced while a flight, its console or another program reads it; "
                "end that and give the same command again, or choose another folder"
            ) from error
        yield
    finally:
        os.close(folder)


def _opened(path: Path) -> int:
    try:
        return os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise MapCacheError(f"{path}: cannot be read: {error.strerror}") from error


def _lock(folder: int, kind: int) -> None:
    """BlockingIOError if another process has the lock; other errors mean that no locks exist."""
    try:
        flock(folder, kind | LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return
