"""Raw .tlog recorder: each frame behind its UTC time, as every MAVLink ground tool reads it."""

from __future__ import annotations

import struct
import threading
from pathlib import Path

_MAX_BYTES = 2 << 30


class TlogRecorder:
    """Appends frames to a .tlog file: 8 bytes of big-endian microseconds UTC, then the frame."""

    def __init__(self, path: Path, max_bytes: int = _MAX_BYTES) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("ab")
        self._lock = threading.Lock()
        self._left = max_bytes
        self.dropped = 0

    def write(self, frame: bytes, time_us: int) -> None:
        """Record one frame; a full disk or a full file costs the record, not the flight."""
        with self._lock:
            size = 8 + len(frame)
            if self._file.closed or self._left < size:
                self.dropped += 1
                return
            try:
                self._file.write(struct.pack(">Q", time_us) + frame)
                self._left -= size
            except OSError:
                self.dropped += 1

    def close(self) -> None:
        """Flush and close."""
        with self._lock:
            self._file.close()
