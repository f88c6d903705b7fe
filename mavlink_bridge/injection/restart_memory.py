"""State that a process stores in a small file for the process that replaces it.

Without it, a companion that is killed while it injects would restart with injection disabled, and
the vehicle would lose its position and land. If the shadow check had failed, the new process would
inject after GNSS is lost. The file is renewed every 30 s while its state holds; after 600 s it is
not used.
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

from mavlink_bridge.atomic_file import read_small_file, replace_file
from mavlink_bridge.link.clock import boot_id

_log = logging.getLogger(__name__)
_OLDEST_S = 600.0
_RENEW_S = 30.0
_STOP_S = 2.0


class RestartMemory:
    """Stores a state for the process that replaces a killed one, and reads that of the process
    before. It writes in its own thread, so that a hanging disk blocks no other thread.

    about: what the state refers to, for example map and camera; the state of another `about` is
    ignored. wall_s: UTC seconds; boot, clock_s: identifier of the boot, and CLOCK_MONOTONIC. The
    age of the state is measured by this clock, which nobody can set. After a power loss in the air
    it is measured by the wall clock.
    """

    def __init__(
        self,
        path: Path,
        wall_s: Callable[[], float] = time.time,
        clock_s: Callable[[], float] = time.monotonic,
        boot: str | None = None,
        about: str = "",
    ) -> None:
        self._path, self.about = path, about
        self._wall_s, self._clock_s = wall_s, clock_s
        self._boot = boot_id() if boot is None else boot
        self._wake = threading.Event()
        self._stopping = self._in_use = False
        self._state: dict[str, Any] | None = None
        self._thread = threading.Thread(target=self._run, name=path.stem, daemon=True)
        self._thread.start()

    def recall_state(self) -> tuple[dict[str, Any], float] | None:
        """The stored state and its age, s; None if there is none, it is older than 600 s, or it
        cannot be trusted. After this call a clean `stop` deletes the file.
        """
        self._in_use = True
        try:
            status = os.lstat(self._path)
            private = stat.S_ISREG(status.st_mode) and not status.st_mode & 0o077
            if not private or status.st_uid != os.geteuid():
                _log.warning("%s is not this user's alone (mode 0600): ignored", self._path)
                return None
            content = json.loads(read_small_file(self._path))
            age_s = self._age_s(content)
            if self.about and content.get("about", self.about) != self.about:
                _log.warning("%s is of something else than what flies now: ignored", self._path)
                return None
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            _log.warning("%s cannot be used: %s", self._path, error)
            return None
        return (content, age_s) if 0.0 <= age_s <= _OLDEST_S else None

    def store_state(self, state: dict[str, Any]) -> None:
        """Write this state (JSON values) now and every 30 s, in the memory's thread."""
        self._in_use = True
        self._state = state
        self._wake.set()

    def drop(self) -> None:
        """Delete the file, in the memory's thread, and write nothing until the next
        `store_state`."""
        self._state = None
        self._wake.set()

    def stop(self, *, clean_shutdown: bool = True) -> None:
        """End the thread. After a clean shutdown the file is removed, otherwise it is kept for the
        next process. Only the first call has an effect.

        A standby that never flew does not touch the file, because the file belongs to the flight
        process.
        """
        if not self._stopping:
            if clean_shutdown:
                self._state = None
            else:
                self._in_use = False
            self._stopping = True
            self._wake.set()
        self._thread.join(_STOP_S)

    def _age_s(self, content: dict[str, Any]) -> float:
        utc_s = float(content["utc_s"])
        if self._boot and content.get("boot") == self._boot:
            return self._clock_s() - float(content["clock_s"])
        return self._wall_s() - utc_s

    def _run(self) -> None:
        known: bool | None = None  # whether there is a file of ours
        while True:
            self._wake.wait(_RENEW_S if self._state is not None else None)
            self._wake.clear()
            stopping = self._stopping  # before the write: an order to end that comes in it is next
            state = self._state
            try:
                if state is not None:
                    self._write(state)
                elif self._in_use:
                    self._path.unlink(missing_ok=True)
                known = True
            except OSError as error:
                if known is not False:
                    _log.warning("%s is not kept: %s", self._path, error)
                known = False
            if stopping:
                return

    def _write(self, state: dict[str, Any]) -> None:
        """Replace the file atomically."""
        stamps = {"utc_s": self._wall_s(), "boot": self._boot, "clock_s": self._clock_s()}
        about = {"about": self.about} if self.about else {}
        replace_file(self._path, json.dumps(state | about | stamps), durable=True)


class InjectionEnableMemory(RestartMemory):
    """Remembers that injection is enabled; `drop` it when injection is disabled."""

    def recall(self) -> tuple[bool, float] | None:
        """Whether an RC channel (True) or a command (False) enabled injection, and the state's age,
        s; None if injection was disabled or the file cannot be trusted.
        """
        found = self.recall_state()
        if found is None or found[0].get("open") is not True:
            return None
        return found[0].get("by_channel") is True, found[1]

    def store_enabled(self, *, by_channel: bool) -> None:
        """Store that injection is enabled. by_channel: by an RC channel, otherwise by a command."""
        self.store_state({"open": True, "by_channel": by_channel})


class ShadowFailureMemory(RestartMemory):
    """Remembers a failed shadow check."""

    _kept = False

    def recall(self) -> bool:
        """Whether the shadow check had failed in the previous process; that is stored again."""
        found = self.recall_state()
        state = None if found is None else found[0].get("against")
        of_0_1 = isinstance(state, str) and bool(state) and state.isprintable()  # the reason
        against = state is True or of_0_1
        self.store(against)
        return against

    def store(self, against: bool) -> None:
        """Store whether the shadow check has failed, if this changed."""
        if against == self._kept:
            return
        self._kept = against
        if against:
            self.store_state({"against": True})
        else:
            self.drop()
