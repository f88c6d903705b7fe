"""Lists the flight records beside the deployment's own, for download."""

from __future__ import annotations

import os
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from companion.offline.record import document

MANIFEST = "record.json"
_MOST = 200  # newest first
_MOST_FILES = 100_000
_CHUNK = 256 << 10


@dataclass(frozen=True)
class RecordFolder:
    """One record. started_utc_ns: None if unknown; ended: how the flight ended, "not ended" if it
    has not, or was cut off.
    """

    name: str
    path: Path
    started_utc_ns: int | None
    ended: str


class Records:
    """Lists records and finds them by listed names, so that a request cannot give a path."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def list_records(self) -> list[RecordFolder]:
        """The folder's records, newest first, at most 200, without links; [] if it is missing."""
        if self._folder is None or not self._folder.is_dir():
            return []
        found = []
        for path in self._folder.iterdir():
            if path.is_symlink() or not path.is_dir() or not (path / MANIFEST).is_file():
                continue
            started = document(path / MANIFEST).get("utc_ns")
            health = document(path / "health.json")
            ended = str(health.get("text", "")) if health.get("level") == "ended" else "not ended"
            when = started if isinstance(started, int) else None
            found.append(RecordFolder(path.name, path, when, ended[:200]))
        found.sort(key=lambda r: r.started_utc_ns or 0, reverse=True)
        return found[:_MOST]

    def find(self, name: str) -> RecordFolder | None:
        """The record of exactly that name; None without one."""
        return next((r for r in self.list_records() if r.name == name), None)


def archive(record: RecordFolder) -> Iterator[bytes]:
    """Yield the record as a .tar in pieces, plain files only, with bounded memory."""
    for path in _plain_files(record.path):
        try:
            file = path.open("rb")
        except OSError:
            continue  # it went meanwhile; a flight may be writing
        with file:
            info = tarfile.TarInfo(f"{record.name}/{path.relative_to(record.path)}")
            info.size = os.fstat(file.fileno()).st_size
            yield info.tobuf(tarfile.PAX_FORMAT)
            yield from _content(file, info.size)
    yield bytes(2 * tarfile.BLOCKSIZE)


def _content(file: BinaryIO, size: int) -> Iterator[bytes]:
    """Yield `size` bytes of a file, then zeros up to a whole block. If the file has shrunk, zeros
    fill it; if it has grown, the rest is left out.
    """
    left = size
    while left > 0:
        try:
            data = file.read(min(left, _CHUNK))
        except OSError:
            data = b""
        data = data or bytes(min(left, _CHUNK))
        left -= len(data)
        yield data
    if size % tarfile.BLOCKSIZE:
        yield bytes(-size % tarfile.BLOCKSIZE)


def _plain_files(folder: Path) -> Iterator[Path]:
    count = 0
    for path in sorted(folder.rglob("*")):
        inside = not any(p.is_symlink() for p in (path, *path.parents) if p.is_relative_to(folder))
        if inside and path.is_file():
            count += 1
            if count > _MOST_FILES:
                return
            yield path
