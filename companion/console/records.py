"""The records that lie beside the deployment's own, to list and to download."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from localizer.plain_files import plain_text

MANIFEST = "record.json"
_MOST = 200  # newest first
_MOST_FILES = 100_000
_CHUNK = 256 << 10


@dataclass(frozen=True)
class RecordFolder:
    """One record. started_utc_ns: None where it does not say."""

    name: str
    path: Path
    started_utc_ns: int | None
    ended: str


class Records:
    """Knows a record only by a name that it listed itself: no path comes from outside."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def listed(self) -> list[RecordFolder]:
        """Every record, newest first. Links are left out: `latest`, and what leads elsewhere."""
        if self._folder is None or not self._folder.is_dir():
            return []
        found = []
        for path in self._folder.iterdir():
            if path.is_symlink() or not path.is_dir() or not (path / MANIFEST).is_file():
                continue
            started = _document(path / MANIFEST).get("utc_ns")
            health = _document(path / "health.json")
            ended = str(health.get("text", "")) if health.get("level") == "ended" else "not ended"
            when = started if isinstance(started, int) else None
            found.append(RecordFolder(path.name, path, when, ended[:200]))
        found.sort(key=lambda r: r.started_utc_ns or 0, reverse=True)
        return found[:_MOST]

    def find(self, name: str) -> RecordFolder | None:
        """The record of exactly that name."""
        return next((r for r in self.listed() if r.name == name), None)


def archive(record: RecordFolder) -> Iterator[bytes]:
    """The record as a .tar, piece by piece. Only plain files of the folder itself go in."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for path in _plain_files(record.path):
            name = f"{record.name}/{path.relative_to(record.path)}"
            try:
                data = path.read_bytes()
            except OSError:
                continue  # it went meanwhile; a flight may be writing
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
            if buffer.tell() > _CHUNK:
                yield _emptied(buffer)
    yield buffer.getvalue()


def _emptied(buffer: io.BytesIO) -> bytes:
    data = buffer.getvalue()
    buffer.seek(0)
    buffer.truncate()
    return data


def _plain_files(folder: Path) -> Iterator[Path]:
    count = 0
    for path in sorted(folder.rglob("*")):
        inside = not any(p.is_symlink() for p in (path, *path.parents) if p.is_relative_to(folder))
        if inside and path.is_file():
            count += 1
            if count > _MOST_FILES:
                return
            yield path


def _document(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(plain_text(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}
