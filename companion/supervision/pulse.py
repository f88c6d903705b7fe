"""Sends signs of life four times a second to the supervisor, which restarts a hanging process.

A process whose threads hang is not dead, and its heartbeat may continue. So each thread that a
position needs stores the time of its last cycle; the oldest is sent.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping

from companion.ending import wait_for_end
from companion.supervision.processes import ENDING
from mavlink_bridge.link.clock import monotonic_ns

_PERIOD_S = 0.25


class Pulse:
    """Writes ``NAME MILLISECONDS`` lines: the component whose last cycle is oldest, and its age.

    beats: times of the components' last cycles, CLOCK_MONOTONIC ns; ages count from the start at
    the earliest. descriptor: of a pipe, closed at the end. Writing does not wait for a supervisor
    that does not read.
    """

    def __init__(self, beats: Callable[[], Mapping[str, int]], descriptor: int) -> None:
        self._beats, self._descriptor = beats, descriptor
        os.set_inheritable(descriptor, False)
        os.set_blocking(descriptor, False)
        self._begun_ns = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._begun_ns = monotonic_ns()
        self._thread.start()

    def stop(self, *, clean_shutdown: bool) -> None:
        """Stop the thread, announce the end and close the pipe. After a clean shutdown the
        supervisor allows time to close a recording; after an error it restarts soon.
        """
        self._stop.set()
        ended = wait_for_end(self._thread)
        self._say(f"{ENDING if clean_shutdown else 'failing'} 0\n".encode())
        if ended:  # else its next line would go into whatever file has the number then
            os.close(self._descriptor)

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            turns = {name: max(at, self._begun_ns) for name, at in self._beats().items()}
            self._say(line(turns, monotonic_ns()))

    def _say(self, text: bytes) -> None:
        try:
            os.write(self._descriptor, text)
        except OSError:  # full, or the supervisor is gone: the flight goes on alone
            return


def line(beats: Mapping[str, int], now_ns: int) -> bytes:
    """The line of `Pulse` for now_ns, with `-` for blanks in the name; ``all 0`` without
    components. beats: times of their last cycles, ns.
    """
    if not beats:
        return b"all 0\n"
    name = min(beats, key=lambda one: beats[one])
    age_ms = max(now_ns - beats[name], 0) // 1_000_000
    return f"{name.replace(' ', '-')} {age_ms}\n".encode()
