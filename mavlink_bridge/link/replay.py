"""Replay protection of signed links that survives a restart: the newest time stamps, in a file.

Signing rejects a frame that is not newer than the last of its stream. If the stamps were in memory
only, a recorded command such as "injection on" would be accepted again after a restart.
"""

from __future__ import annotations

import json
import logging
import threading
from pathlib import Path

from mavlink_bridge.atomic_file import read_small_file, replace_file

_log = logging.getLogger(__name__)

_LEASE = 200_000  # 10 us ticks: 2 s
_MAX_SIZE = 1 << 20
NO_STAMP = 1 << 47  # of 48 bits; the half of them last until 2059

Stream = tuple[int, int, int]
"""Link id, system, component of a signed frame."""


class ReplayWindow:
    """Stores the newest timestamps of a link's streams in a file of mode 0600.

    The stored timestamps are 2 s ahead of the received ones. So one write covers the messages of a
    second, and none of them can be replayed after a kill. After a start our own timestamps begin
    later than the stored ones, and a peer that does not know the time follows them. A thread of its
    own writes, so that the disk cannot stop a link. A file that is lost or damaged is reported in
    the log and restarted.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._due = threading.Event()
        self._closing = False
        self._failed = False
        self.streams: dict[Stream, int] = self._read()
        self._leases = dict(self.streams)
        self._thread = threading.Thread(target=self._run, name="replay-window", daemon=True)
        self._thread.start()

    @property
    def newest(self) -> int:
        """The newest stored stamp, 10 us ticks, 2 s ahead of the accepted one; 0 for none."""
        with self._lock:
            return max(self._leases.values(), default=0)

    def add_accepted(self, stream: Stream, stamp: int) -> None:
        """Note the timestamp (10 µs) of an accepted frame. Another thread writes it to disk, so
        this call never blocks.
        """
        with self._lock:
            if stamp + _LEASE // 2 <= self._leases.get(stream, 0):
                return
            self._leases[stream] = stamp + _LEASE
        self._due.set()

    def close(self) -> None:
        """Write the last state and end the thread; waits about 2 s at most for a hanging disk."""
        self._closing = True
        self._due.set()
        self._thread.join(2.0)

    def _run(self) -> None:
        while True:
            self._due.wait()
            self._due.clear()
            closing = self._closing  # before the write: what comes in it is written next
            self._write()
            if closing:
                return

    def _write(self) -> None:
        with self._lock:
            document = {":".join(map(str, key)): stamp for key, stamp in self._leases.items()}
        try:
            replace_file(self._path, json.dumps(document), durable=True)
        except OSError as error:
            if not self._failed:
                _log.warning(
                    "%s: cannot be written (%s): signed messages of now can be repeated after a "
                    "restart; set signing.state_file to a place that can",
                    self._path, error,
                )  # fmt: skip
            self._failed = True

    def _read(self) -> dict[Stream, int]:
        try:
            document = json.loads(read_small_file(self._path, _MAX_SIZE))
            return {_stream(key): _stamp(stamp) for key, stamp in document.items()}
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, AttributeError, TypeError, RecursionError) as error:
            _log.warning(
                "%s: unreadable (%s): restarted, messages from before can be repeated once",
                self._path, error,
            )  # fmt: skip
            return {}


def _stream(key: str) -> Stream:
    link, system, component = (int(part) for part in key.split(":"))
    if not all(0 <= part <= 255 for part in (link, system, component)):
        raise ValueError(f"{key} names no stream")
    return link, system, component


def _stamp(given: object) -> int:
    """A timestamp that a frame can carry; ValueError for others: ours would begin after it."""
    if not isinstance(given, int) or isinstance(given, bool) or not 0 <= given < NO_STAMP:
        raise ValueError(f"{str(given)[:40]} is no stamp of a frame")
    return given
