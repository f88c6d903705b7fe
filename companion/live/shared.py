"""Shared memory that passes a frame from the flight to one console without a copy through a socket.

Through a stream socket, 2 MB are a dozen pieces. For each, the flight's thread would wake and wait
for a console of much lower priority. Here the flight writes once, into memory that it allocated. A
message announces the frame, and the console answers when it has read it. Neither side maps the
memory, because whoever shortens a mapped file kills the process that reads it.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence

import numpy as np

from companion.live.protocol import MOST_BODY, LinkError


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
            raise LinkError(f"a picture of {size} bytes without memory that holds it")
        data = os.pread(self._file, size, 0)
        if len(data) != size:
            raise LinkError(f"a picture of {size} bytes of which {len(data)} are there")
        return data

    def close(self) -> None:
        """Close socket and shared memory."""
        self._forget()
        self._connection.close()

    def _forget(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None
