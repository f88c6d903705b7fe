"""A pipe that wakes a thread which waits in poll."""

from __future__ import annotations

import contextlib
import os
import threading


class WakePipe:
    """Wakes a polling thread from any thread; the polling thread reads `read_end`.

    read_end, write_end: non-blocking descriptors; invalid after `close`.
    """

    def __init__(self) -> None:
        # The pipe's numbers may be other files' once it is closed: nobody writes while it is.
        self._lock = threading.Lock()
        self._closed = False
        self.read_end, self.write_end = os.pipe()
        os.set_blocking(self.read_end, False)
        os.set_blocking(self.write_end, False)

    def wake(self) -> None:
        """Make the read end readable; never blocks, and does nothing after `close`."""
        # A full pipe wakes the thread anyway, and a closed one has no thread to wake.
        with self._lock, contextlib.suppress(BlockingIOError):
            if not self._closed:
                os.write(self.write_end, b"w")

    def close(self) -> None:
        """Close both ends; harmless when called again."""
        with self._lock:
            if not self._closed:
                self._closed = True
                os.close(self.read_end)
                os.close(self.write_end)
