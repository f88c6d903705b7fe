"""Messages between flight and console over a local stream socket.

One message: two big-endian uint32 (bytes of head and body), the head as JSON, the body. A frame's
body is in shared memory (`live.shared`); its head's "shared" is the number of bytes there. Both
sides limit the sizes that they accept.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import struct
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.errors import CompanionError

MOST_HEAD = 1 << 20
MOST_BODY = 64 << 20
MOST_ORDER = 4096  # bytes of what the console may say at once
_SIZES = struct.Struct(">II")


class LinkError(CompanionError):
    """Invalid bytes from the other side, or a socket that cannot be opened."""


@dataclass(frozen=True)
class Message:
    """head: JSON object, whose "kind" names the message; body: bytes."""

    head: dict[str, Any]
    body: bytes = b""


def encode(head: dict[str, Any], body: bytes = b"") -> bytes:
    """Encode a message. ValueError for NaN, which browsers cannot read."""
    text = json.dumps(head, allow_nan=False, separators=(",", ":")).encode()
    return b"".join((_SIZES.pack(len(text), len(body)), text, body))


class MessageDecoder:
    """Decodes messages from a byte stream. most_head, most_body: size limits, bytes."""

    def __init__(self, most_head: int = MOST_HEAD, most_body: int = MOST_BODY) -> None:
        self._most_head, self._most_body = most_head, most_body
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[Message]:
        """Add received bytes; yields the messages that are complete. It is a generator: iterate it
        to its end, or bytes are not added. `LinkError` for bad data.
        """
        self._buffer += data
        while len(self._buffer) >= _SIZES.size:
            head, body = _SIZES.unpack_from(self._buffer)
            if head > self._most_head or body > self._most_body:
                raise LinkError(f"a message of {head} + {body} bytes is too long")
            end = _SIZES.size + head + body
            if len(self._buffer) < end:
                return
            raw = bytes(self._buffer[_SIZES.size : end])
            del self._buffer[:end]
            try:
                value = json.loads(raw[:head])
            except (ValueError, RecursionError) as error:
                raise LinkError(f"not a message: {error}") from error
            if not isinstance(value, dict):
                raise LinkError("not a message: its head is no object")
            yield Message(value, raw[head:])


def socket_path(map_path: Path, record: Path | None, listen: str) -> Path:
    """Path of the socket, the same in flight and console, in a folder of this user.

    Each deployment (map, record, address) has its own. It is short: socket addresses end at 107
    bytes. Creates the folder; `LinkError` as of `runtime_folder`.
    """
    key = f"{Path(map_path).absolute()}\0{record and Path(record).absolute()}\0{listen}"
    name = hashlib.sha256(key.encode()).hexdigest()[:16]
    return runtime_folder() / f"{name}.sock"


def runtime_folder() -> Path:
    """Make and return a folder that only this user can enter; `LinkError` if that is impossible."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(base) if base else Path(tempfile.gettempdir()) / f"companion-{os.getuid()}"
    if base:
        folder = folder / "companion"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise LinkError(f"{folder}: no place for the console's socket: {error}") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise LinkError(f"{folder}: is not a folder of this user alone (0700); remove it")
    return folder
