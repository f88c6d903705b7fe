"""Passes the autopilot's messages to the threads that wait for them."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Iterator
from typing import Any

from sitl.ground.vehicle_record import from_autopilot


class AutopilotQueues:
    """Queues of the autopilot's messages: one thread adds messages, any thread waits for types."""

    def __init__(self) -> None:
        self._boxes: list[tuple[frozenset[str], queue.SimpleQueue[Any]]] = []

    def add(self, message: Any) -> None:
        """Put a message into every queue that expects its type; other components' messages are
        ignored.
        """
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
