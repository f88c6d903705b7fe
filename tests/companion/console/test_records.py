"""A record as .tar: whole, piece by piece, whatever becomes of its files meanwhile."""

from __future__ import annotations

import io
import os
import tarfile
from pathlib import Path

from companion.console.records import RecordFolder, archive

PIECE = 256 << 10


def record(folder: Path) -> RecordFolder:
    return RecordFolder(folder.name, folder, None, "ended")


def test_a_large_file_is_never_whole_in_memory(tmp_path: Path) -> None:
    """A .tlog of two GiB was read at once, beside a flight that needs its memory."""
    flight = tmp_path / "flight"
    (flight / "snapshots").mkdir(parents=True)
    (flight / "record.json").write_text("{}")
    (flight / "empty.csv").touch()
    (flight / "snapshots" / "ü.jpg").write_bytes(os.urandom(1000))
    content = os.urandom(3 * PIECE + 5)
    (flight / "bridge.tlog").write_bytes(content)
    pieces = list(archive(record(flight)))
    assert max(map(len, pieces)) <= PIECE
    with tarfile.open(fileobj=io.BytesIO(b"".join(pieces))) as tar:
        found = {m.name: m.size for m in tar.getmembers()}
        assert found == {
            "flight/record.json": 2, "flight/empty.csv": 0, "flight/snapshots/ü.jpg": 1000,
            "flight/bridge.tlog": len(content),
        }  # fmt: skip
        told = tar.extractfile("flight/bridge.tlog")
        assert told.read() == content


def test_a_file_that_grows_or_shrinks_meanwhile_spoils_no_other(tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    flight.mkdir()
    for name in "abc":
        (flight / name).write_bytes(name.encode() * (2 * PIECE))
    pieces = []
    for piece in archive(record(flight)):
        pieces.append(piece)
        if len(pieces) == 1:
            os.truncate(flight / "a", PIECE)
            with (flight / "b").open("ab") as file:
                file.write(b"more")
    with tarfile.open(fileobj=io.BytesIO(b"".join(pieces))) as tar:
        assert tar.getnames() == ["flight/a", "flight/b", "flight/c"]
        last = tar.extractfile("flight/c")
        assert last.read() == b"c" * (2 * PIECE)
        first = tar.extractfile("flight/a")
        assert first.read() == b"a" * PIECE + bytes(PIECE)
