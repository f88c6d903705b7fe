"""Writes and reads .tlog files: each raw frame after its UTC time, as MAVLink ground tools do.

A thread writes the file, so that a slow memory card does not delay an injection.
"""

from __future__ import annotations

import errno
import logging
import stat
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator
from io import FileIO
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.errors import TlogError

_log = logging.getLogger(__name__)

_MAX_BYTES = 2 << 30
WHOLE, PART = "it has 2 GiB", "the disk took only a part"
"""Why the file ends, for the operator."""
_MAX_WAITING = 8192  # frames: 10 s of five times the usual traffic
_WRITE_EVERY_S = 0.2
_CLOSE_S = 5.0
_FRAME_START = {0xFE: (8, 1), 0xFD: (12, 1)}  # bytes beside the payload, place of its length
_SIGNATURE_BYTES = 13

_DISK_FAULTS = (
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO,
    # The file system is damaged or was taken down; the stick, or what serves it, is gone.
    errno.EUCLEAN, errno.ESHUTDOWN, errno.ENODEV, errno.ENXIO, errno.ENOMEDIUM, errno.EREMOTEIO,
    errno.ENOTCONN, errno.ESTALE, errno.ETIMEDOUT,
)  # fmt: skip


def is_disk_fault(error: OSError) -> bool:
    """Whether an error means that the disk is full or failing. A start, which may be a restart in
    the air, then continues without a record. A wrong path or missing permission is an error.
    """
    return error.errno in _DISK_FAULTS


class TlogRecorder:
    """Appends frames to a .tlog file: 8 bytes of big-endian microseconds UTC, then the frame.

    Raises `TlogError` if the file cannot be opened, unless the disk is full or failing. Frames that
    cannot be written are dropped and counted, also beyond max_bytes. on_failure: called once with
    the reason, in the recorder's thread.
    """

    def __init__(
        self,
        path: Path,
        on_failure: Callable[[str], None] = lambda _: None,
        max_bytes: int = _MAX_BYTES,
    ) -> None:
        self._file: FileIO | None = None
        self._refusal = ""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            self._refusal = error.strerror or str(error)
            if not is_disk_fault(error):
                raise TlogError(
                    f"bridge.tlog {path}: cannot be written ({error.strerror}); choose another "
                    "file or leave tlog empty"
                ) from error
        self._path = path
        self._on_failure = on_failure
        self._left = max_bytes
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._failed = False
        self.dropped = 0

    def start(self) -> None:
        """Start the thread that writes the file."""
        self._thread = threading.Thread(target=self._run, name="tlog", daemon=True)
        self._thread.start()

    def write(self, frame: bytes, time_us: int) -> None:
        """Queue a frame of time_us (UTC, microseconds), or drop it if 8192 wait; never blocks."""
        if len(self._waiting) >= _MAX_WAITING:
            self.dropped += 1
            return
        self._waiting.append((time_us, frame))

    def close(self) -> None:
        """Write the queue and close the file. If the disk hangs, this returns after 5 s and leaves
        the file open.
        """
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_CLOSE_S)
            if self._thread.is_alive():
                _log.warning("%s: the record is incomplete: its disk does not answer", self._path)
                return
        if self._file is not None:
            try:
                self._file.close()
            except OSError as error:
                self._fail(str(error))

    def _run(self) -> None:
        while not self._stop.wait(_WRITE_EVERY_S):
            self._write_waiting()
        self._write_waiting()

    def _write_waiting(self) -> None:
        """Write all queued records at once, so that a crash leaves a file that can be read."""
        records = bytearray()
        count = len(self._waiting)
        for _ in range(count):
            time_us, frame = self._waiting.popleft()
            records += struct.pack(">Q", time_us) + frame
        if not records:
            return
        if self._file is None:
            self.dropped += count
            self._fail(self._refusal)
            return
        if len(records) > self._left:
            self.dropped += count
            self._fail(WHOLE)
            return
        try:
            written = self._file.write(records)
        except OSError as error:
            written = 0
            self._fail(error.strerror or str(error))
        self._left -= written
        if written == len(records):
            return
        self.dropped += count
        if written:
            self._left = 0  # half a record ends the file: what came behind it could not be read
            self._fail(PART)

    def _fail(self, why: str) -> None:
        if not self._failed:
            self._failed = True
            _log.warning("%s: the record is incomplete: %s", self._path, why)
            self._on_failure(why)


def read_tlog(path: Path) -> Iterator[tuple[int, Any]]:
    """Yield (UTC ns, message) of every frame of a .tlog in file order; frames that cannot be
    decoded are skipped. `TlogError`, while it is iterated, for a file that cannot be read or has no
    frame, and where no frame begins after the one before.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a record names it: a pipe or a device has no end
            raise TlogError(f"{path}: is not a plain file")
        if status.st_size > _MAX_BYTES:
            raise TlogError(f"{path}: is larger than the {_MAX_BYTES >> 30} GiB of a .tlog")
        data = path.read_bytes()
    except OSError as error:
        raise TlogError(f"{path}: cannot be read: {error.strerror}") from error
    codec = mavlink.MAVLink(None)
    codec.robust_parsing = True
    at = 0
    while at + 10 <= len(data):
        (time_us,) = struct.unpack_from(">Q", data, at)
        size = _frame_size(data, at + 8)
        frame = data[at + 8 : at + 8 + size]
        at += 8 + size
        for message in codec.parse_buffer(frame) or []:
            if message.get_type() != "BAD_DATA":
                yield time_us * 1000, message
    if at == 0:
        raise TlogError(f"{path}: holds no MAVLink frame")


def _frame_size(data: bytes, at: int) -> int:
    if data[at] not in _FRAME_START:
        raise TlogError(f"tlog: no MAVLink frame at byte {at}; the file is damaged")
    overhead, length_at = _FRAME_START[data[at]]
    is_signed = data[at] == 0xFD and at + 2 < len(data) and data[at + 2] & 1
    return overhead + data[at + length_at] + (_SIGNATURE_BYTES if is_signed else 0)
