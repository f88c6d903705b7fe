"""Passes the newest item between threads; replaced items are counted."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


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
