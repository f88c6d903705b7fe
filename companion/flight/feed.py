"""The camera's frames, read on a thread of their own until the source ends."""

from __future__ import annotations

import threading
from collections.abc import Callable

from companion.sources import FrameSource
from localizer.types import Frame


class Feed:
    """Hands every frame of a source on. ended: set when the source has no more; error: what ended
    it, None for a regular end.
    """

    def __init__(self, source: FrameSource, take: Callable[[Frame], None]) -> None:
        self._source = source
        self._take = take
        self.ended = threading.Event()
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="feed")

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Close the source and wait for the thread."""
        self._source.close()
        self._thread.join()

    def _run(self) -> None:
        try:
            for frame in self._source.frames():
                self._take(frame)
        except Exception as error:
            self.error = error
        self.ended.set()
