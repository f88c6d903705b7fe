"""Reads the camera's frames on its own thread until the source ends."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from companion.ending import wait_for_end
from companion.sources import FrameSource
from localizer.types import Frame

_log = logging.getLogger(__name__)


class Feed:
    """Passes every frame of a source to `take`, on its own thread. ended: set when the source ends;
    error: what ended it, None for a normal end. failures: number of frames for which `take` raised;
    the flight continues.
    """

    def __init__(self, source: FrameSource, take: Callable[[Frame], None]) -> None:
        self._source = source
        self._take = take
        self.ended = threading.Event()
        self.error: Exception | None = None
        self.failures = 0
        self._taken_ns: int | None = None
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Close the source and wait for the thread."""
        self._source.close()
        wait_for_end(self._thread)

    @property
    def last_tick_ns(self) -> int:
        """When the present frame came, CLOCK_MONOTONIC; now while waiting for a frame."""
        taken_ns = self._taken_ns
        return time.monotonic_ns() if taken_ns is None else taken_ns

    def _run(self) -> None:
        try:
            for frame in self._source.frames():
                self._taken_ns = time.monotonic_ns()
                self._pass_on(frame)
                self._taken_ns = None
        except Exception as error:
            self.error = error
        self.ended.set()

    def _pass_on(self, frame: Frame) -> None:
        try:
            self._take(frame)
        except Exception:  # a part's fault, which the others and the next frames do not share
            self.failures += 1
            if self.failures in (1, 10, 100, 1000):
                _log.exception("a part failed on a frame (%d times)", self.failures)
