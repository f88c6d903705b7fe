"""A hand-over that holds one item: the newest wins, and what it overwrites is counted."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class NewestSlot(Generic[T]):
    """One-slot queue between a producer that must not wait and a slower consumer."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: T | None = None
        self._error: Exception | None = None
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """How many items were overwritten before they were fetched."""
        with self._changed:
            return self._dropped

    def put(self, item: T) -> bool:
        """Stores the item, over an older one if nobody fetched it; never waits. False if closed."""
        with self._changed:
            if self._closed:
                return False
            if self._item is not None:
                self._dropped += 1
            self._item = item
            self._changed.notify()
            return True

    def get(self) -> T | None:
        """Waits for an item; None once the slot is closed; raises what the producer failed with."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed)
            if self._error is not None:
                raise self._error
            if self._closed:
                return None
            item, self._item = self._item, None
            return item

    def close(self, error: Exception | None = None) -> None:
        """Wakes the consumer for good, with an error or without."""
        with self._changed:
            if self._closed:
                return
            self._closed, self._error = True, error
            self._changed.notify_all()
