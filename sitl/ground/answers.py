"""Passes the autopilot's answers to the threads that wait for them."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Iterator
from typing import Any

from sitl.ground.vehicle_record import from_autopilot


class Answers:
    """Message queues by type: one thread fills them, any thread waits."""

    def __init__(self) -> None:
        self._boxes: list[tuple[frozenset[str], queue.SimpleQueue[Any]]] = []

    def take(self, message: Any) -> None:
        """Put a message into the queues of its type."""
        if from_autopilot(message):
            for kinds, box in self._boxes:
                if message.get_type() in kinds:
                    box.put(message)

    @contextlib.contextmanager
    def expect(self, *kinds: str) -> Iterator[queue.SimpleQueue[Any]]:
        """Context manager: a queue of the autopilot's messages of these types, from now on."""
        box: queue.SimpleQueue[Any] = queue.SimpleQueue()
        entry = (frozenset(kinds), box)
        self._boxes = [*self._boxes, entry]
        try:
            yield box
        finally:
            self._boxes = [e for e in self._boxes if e is not entry]
