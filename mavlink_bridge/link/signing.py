"""MAVLink 2 signing: the key file, signing state of a sending component, protection from replay.

https://mavlink.io/en/guide/message_signing.html

Replay: signing rejects a frame that is not newer than the last of its stream. If the stamps were in
memory only, a recorded command such as "injection on" would be accepted again after a restart.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import stat
import threading
import time
from pathlib import Path
from typing import Any

from mavlink_bridge.atomic_file import read_small_file, replace_file
from mavlink_bridge.errors import SigningKeyError

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


_SIGNING_EPOCH_S = 1420070400  # 2015-01-01 UTC
_TICKS_PER_S = 100_000  # time stamps count 10 microseconds
_LONGEST_TEXT = 1024


def load_key(path: Path) -> bytes:
    """Read the 32-byte key from a file of 64 hexadecimal digits that only its owner can read.
    `SigningKeyError` for every other file.
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):  # a pipe would be waited for without end
            raise SigningKeyError(f"{path}: signing key is no file")
        with path.open(encoding="utf-8-sig") as file:
            text = file.read(_LONGEST_TEXT).strip()
    except (OSError, UnicodeDecodeError) as error:
        raise SigningKeyError(f"{path}: signing key cannot be read ({error})") from error
    if stat.S_IMODE(mode) & 0o077:
        raise SigningKeyError(f"{path}: signing key is readable by others; chmod 600 it")
    try:
        key = bytes.fromhex(text)
    except ValueError as error:
        raise SigningKeyError(f"{path}: signing key must be 64 hexadecimal digits") from error
    if len(key) != 32:
        raise SigningKeyError(f"{path}: signing key has {len(key)} bytes, needs 32")
    if not any(key):
        raise SigningKeyError(
            f"{path}: signing key is zero, which ArduPilot takes for no signing; make a random one"
        )
    return key


def create_key(path: Path) -> bytes:
    """Write a new random key to a new file of mode 0600 and return it; OSError if it exists, or
    cannot be written: then there is none.
    """
    if path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    key = os.urandom(32)
    replace_file(path, key.hex() + "\n", durable=True)
    return key


def signing_timestamp(unix_time_s: float | None = None) -> int:
    """Signing time stamp of a time (now if None): 10 microsecond ticks since 2015-01-01 UTC.

    0 before that: a computer without a battery clock may wake up in 1970.
    """
    now = time.time() if unix_time_s is None else unix_time_s
    return max(int((now - _SIGNING_EPOCH_S) * _TICKS_PER_S), 0)


def enable(mav: Any, key: bytes, link_id: int) -> None:
    """Make a pymavlink `MAVLink` sign what it sends with `key` (32 bytes) and this link id, and
    reject frames that are unsigned or not signed with the key.
    """
    mav.signing.secret_key = key
    mav.signing.link_id = link_id
    mav.signing.timestamp = signing_timestamp()
    mav.signing.sign_outgoing = True
    mav.signing.allow_unsigned_callback = None
