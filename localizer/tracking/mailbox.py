"""Passes the newest item between threads; replaced items are counted.

`FeaturePrefetcher` extracts the next frame's features on the way, while the frame before is being
registered. Two threads share it: one prepares frames (`prepare`), the other takes them (`take`). At
most one frame is extracted ahead. Extraction starts just early enough to finish when the previous
registration ends, so no frame waits.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from localizer.types import FeaturePyramid, Frame

T = TypeVar("T")

_SHARE = 0.25  # of a new duration in the smoothed one


class Mailbox(Generic[T]):
    """One-item queue between a producer that must not wait and a slower consumer."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: T | None = None
        self._error: Exception | None = None
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Number of items replaced before they were taken."""
        with self._changed:
            return self._dropped

    @property
    def is_full(self) -> bool:
        """Whether an item waits, which the next would replace."""
        with self._changed:
            return self._item is not None

    def put(self, item: T) -> bool:
        """Put an item, replacing an older one; never waits. False if closed."""
        with self._changed:
            if self._closed:
                return False
            if self._item is not None:
                self._dropped += 1
            self._item = item
            self._changed.notify()
            return True

    def take(self, timeout_s: float | None = None) -> T | None:
        """Remove and return the item; waits for one, without a timeout for ever. None after the
        timeout, or once closed, even if an item waits.

        Raises the error that `close` was given, at every call.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed, timeout_s)
            if self._error is not None:
                raise self._error
            if self._closed:
                return None
            item, self._item = self._item, None
            return item

    def close(self, error: Exception | None = None) -> None:
        """End it, and wake the consumer with an error or none. Only the first call counts."""
        with self._changed:
            if self._closed:
                return
            self._closed, self._error = True, error
            self._changed.notify_all()


@dataclass(frozen=True)
class PrefetchedFrame:
    """A frame, its features if they were extracted ahead, and the extraction time, ms."""

    frame: Frame
    features: FeaturePyramid | None = None
    extract_ms: float = 0.0


@dataclass
class ProcessingTimes:
    """Smoothed durations of extraction and registration, seconds."""

    extract_s: float = 0.0
    busy_s: float = 0.0

    def add_extraction(self, spent_s: float) -> None:
        """Add the duration of an extraction."""
        self.extract_s += _SHARE * (spent_s - self.extract_s)

    def add_registration(self, spent_s: float) -> None:
        """Add the duration of a registration."""
        self.busy_s += _SHARE * (spent_s - self.busy_s)

    def pause_s(self, since_taken_s: float) -> float:
        """Wait time before the next extraction, so that it ends when the running registration ends
        and can use a newer frame. since_taken_s: since that registration's frame was taken.
        """
        return max(self.busy_s - self.extract_s - since_taken_s, 0.0)


class FeaturePrefetcher:
    """Passes on the newest frame with its features; replaced frames are counted.

    extract: computes a frame's features. may: whether features may be extracted ahead now;
    otherwise the newest frame is passed on without features, when the receiver waits for it.
    """

    def __init__(self, extract: Callable[[Frame], FeaturePyramid], may: Callable[[], bool]) -> None:
        self._extract, self._may = extract, may
        self._frames: Mailbox[Frame] = Mailbox()
        self._prepared: Mailbox[PrefetchedFrame] = Mailbox()
        self._wanted = threading.Event()  # nothing is prepared: the next may be
        self._wanted.set()
        self._waits = threading.Event()  # the taker has nothing to do
        self._taken_s = 0.0
        self._pace = ProcessingTimes()

    @property
    def dropped(self) -> int:
        """Number of frames replaced by a newer one before they were prepared."""
        return self._frames.dropped

    @property
    def is_full(self) -> bool:
        """Whether a frame waits, which the next would replace."""
        return self._frames.is_full

    def put(self, frame: Frame) -> None:
        """Offer a frame; it replaces an unprepared one. Never waits."""
        self._frames.put(frame)

    def prepare(self, timeout_s: float) -> None:
        """Prepare the newest frame when it is due; return after the timeout without one.

        If the extraction fails, the receiver extracts again and gets the error with the frame.
        """
        if not self._wanted.wait(timeout_s):
            return
        may = self._may()
        if may:
            pause_s = self._pace.pause_s(time.monotonic() - self._taken_s)
            self._waits.wait(min(pause_s, timeout_s))
        elif not self._waits.wait(timeout_s):
            return
        frame = self._frames.take(timeout_s)
        if frame is None:
            return
        self._wanted.clear()
        self._prepared.put(self._with_features(frame) if may else PrefetchedFrame(frame))

    def _with_features(self, frame: Frame) -> PrefetchedFrame:
        begun_s = time.monotonic()
        try:
            features = self._extract(frame)
        except Exception:  # the taker's own attempt reports it
            return PrefetchedFrame(frame)
        spent_s = time.monotonic() - begun_s
        self._pace.add_extraction(spent_s)
        return PrefetchedFrame(frame, features, 1e3 * spent_s)

    def take(self, timeout_s: float) -> PrefetchedFrame | None:
        """The next frame, waiting for one; None after the timeout or once closed. The call also
        says that the registration of the frame before has ended.
        """
        if not self._waits.is_set():
            if self._taken_s:
                self._pace.add_registration(time.monotonic() - self._taken_s)
            self._waits.set()
        prepared = self._prepared.take(timeout_s)
        if prepared is not None:
            self._taken_s = time.monotonic()
            self._waits.clear()
            self._wanted.set()
        return prepared

    def close(self) -> None:
        """Wake both threads and end; a frame that waits is dropped."""
        self._frames.close()
        self._prepared.close()
        self._wanted.set()
        self._waits.set()
