"""Messages between flight and console over a local stream socket, and frames in shared memory.

One message: two big-endian uint32 (bytes of head and body), the head as JSON, the body. A frame's
body is in shared memory; its head's "shared" is the number of bytes there. Both
sides limit the sizes that they accept.

Shared memory: through a stream socket, 2 MB are a dozen pieces. For each, the flight's thread would
wake and wait for a console of much lower priority. Here the flight writes once, into memory that it
allocated. A message announces the frame, and the console answers when it has read it. Neither side
maps the memory, because whoever shortens a mapped file kills the process that reads it.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import stat
import struct
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import CompanionError


class SharedMemory:
    """The flight's side: holds one frame; its file descriptor is sent to the console once."""

    def __init__(self) -> None:
        # Without MFD_ALLOW_SEALING: else the other side could forbid that it is written.
        self._file = os.memfd_create("console picture", os.MFD_CLOEXEC)
        self.is_read = True
        """Whether the console has read what was written last; not before is it overwritten."""
        self._given = False

    def write(self, parts: Sequence[np.ndarray]) -> int:
        """Write the arrays in order, over the last frame; returns the number of bytes. Only while
        `is_read`, which is then False. OSError without memory.
        """
        at = 0
        for part in parts:
            rest = np.ascontiguousarray(part).reshape(-1).view(np.uint8).data
            while rest:
                written = os.pwrite(self._file, rest, at)
                rest, at = rest[written:], at + written
        self.is_read = False
        return at

    def send(self, connection: socket.socket, data: memoryview) -> int:
        """As `socket.send`; the first call also sends the file descriptor."""
        if self._given:
            return connection.send(data)
        sent = socket.send_fds(connection, [data], [self._file])
        self._given = sent > 0
        return sent

    def close(self) -> None:
        """Close the flight's file descriptor."""
        os.close(self._file)


class SharedMemoryReader:
    """The console's side: receives socket data and the file descriptor."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._file: int | None = None

    def receive(self, most: int) -> bytes:
        """As `socket.recv`, at most `most` bytes; keeps a file descriptor that comes with them."""
        data, files, _, _ = socket.recv_fds(self._connection, most, 1, socket.MSG_CMSG_CLOEXEC)
        for file in files:
            self._forget()
            self._file = file
        return data

    def read(self, size: int) -> bytes:
        """Read `size` bytes of the shared memory. `LinkError` if there are fewer."""
        if self._file is None or not 0 <= size <= MOST_BODY:
            raise LinkError(f"an image of {size} bytes without memory that holds it")
        data = os.pread(self._file, size, 0)
        if len(data) != size:
            raise LinkError(f"an image of {size} bytes of which {len(data)} are there")
        return data

    def close(self) -> None:
        """Close socket and shared memory."""
        self._forget()
        self._connection.close()

    def _forget(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None


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
