"""What mode ``rc`` remembers over a restart: a small file, and when it is too old to count.

A companion that is killed under denial and comes back with its gate closed would leave the vehicle
without a position: LAND. The file says what the pilot last wanted, and is renewed while it holds.
"""

from __future__ import annotations

import json
import logging
import os
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mavlink_bridge.link.clock import boot_id
from mavlink_bridge.whole_file import read_whole, replace_whole

_log = logging.getLogger(__name__)
_OLDEST_S = 600.0
_RENEW_S = 30.0
_STOP_S = 2.0


class GateMemory:
    """Reads once; writes in a thread of its own, so that a disk that stands still stalls nobody.

    wall_s: UTC seconds; boot, clock_s: of CLOCK_MONOTONIC. Within one run of the computer that
    clock counts, which nobody sets; the wall clock where it lost its power in the air.
    """

    def __init__(
        self,
        path: Path,
        wall_s: Callable[[], float] = time.time,
        clock_s: Callable[[], float] = time.monotonic,
        boot: str | None = None,
    ) -> None:
        self._path = path
        self._wall_s, self._clock_s = wall_s, clock_s
        self._boot = boot_id() if boot is None else boot
        self._wake = threading.Event()
        self._stopping = self._in_use = False
        self._channel: bool | None = None
        self._thread = threading.Thread(target=self._run, name="gate-memory", daemon=True)
        self._thread.start()

    def recall(self) -> tuple[bool, float] | None:
        """Whether the gate was opened by a channel (else by a command), and how long ago that was
        last true, s; None if it was closed, or nothing is known that may be trusted.
        """
        self._in_use = True
        try:
            status = os.lstat(self._path)
            private = stat.S_ISREG(status.st_mode) and not status.st_mode & 0o077
            if not private or status.st_uid != os.geteuid():
                _log.warning("%s is not this user's alone (mode 0600): ignored", self._path)
                return None
            content = json.loads(read_whole(self._path))
            age_s = self._age_s(content)
            opened, channel = content["open"] is True, content["by_channel"] is True
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            _log.warning("%s cannot be used: %s", self._path, error)
            return None
        return (channel, age_s) if opened and 0.0 <= age_s <= _OLDEST_S else None

    def _age_s(self, content: dict[str, Any]) -> float:
        utc_s = float(content["utc_s"])
        if self._boot and content.get("boot") == self._boot:
            return self._clock_s() - float(content["clock_s"])
        return self._wall_s() - utc_s

    def opened(self, *, by_channel: bool) -> None:
        """The gate is open from now on."""
        self._in_use = True
        self._channel = by_channel
        self._wake.set()

    def closed(self) -> None:
        """The gate is closed from now on."""
        self._channel = None
        self._wake.set()

    def stop(self) -> None:
        """End the thread. An orderly end is the pilot's: nothing is remembered of it.

        A standby that never flew leaves the file alone: it is of the process that flies.
        """
        self._channel, self._stopping = None, True
        self._wake.set()
        self._thread.join(_STOP_S)

    def _run(self) -> None:
        known: bool | None = None  # whether there is a file of ours
        while True:
            self._wake.wait(_RENEW_S if self._channel is not None else None)
            self._wake.clear()
            stopping = self._stopping  # before the write: an order to end that comes in it is next
            try:
                if self._channel is not None:
                    self._write(self._channel)
                elif self._in_use:
                    self._path.unlink(missing_ok=True)
                known = True
            except OSError as error:
                if known is not False:
                    _log.warning("the gate's state is not kept: %s: %s", self._path, error)
                known = False
            if stopping:
                return

    def _write(self, by_channel: bool) -> None:
        """Whole or not at all."""
        told = {"open": True, "by_channel": by_channel, "utc_s": self._wall_s()}
        text = json.dumps(told | {"boot": self._boot, "clock_s": self._clock_s()})
        replace_whole(self._path, text, durable=True)
