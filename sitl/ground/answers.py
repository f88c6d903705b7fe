"""What the autopilot answers, put aside for whoever waits for it."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Iterator
from typing import Any

from sitl.ground.vehicle_record import from_autopilot


class Answers:
    """Boxes of messages: one thread takes them in, any thread waits for some kinds."""

    def __init__(self) -> None:
        self._boxes: list[tuple[frozenset[str], queue.SimpleQueue[Any]]] = []

    def take(self, message: Any) -> None:
        """Put a message of the autopilot into the boxes that want it."""
        if from_autopilot(message):
            for kinds, box in self._boxes:
                if message.get_type() in kinds:
                    box.put(message)

    @contextlib.contextmanager
    def expect(self, *kinds: str) -> Iterator[queue.SimpleQueue[Any]]:
        """A box that receives the autopilot's messages of some kinds from now on."""
        box: queue.SimpleQueue[Any] = queue.SimpleQueue()
        entry = (frozenset(kinds), box)
        self._boxes = [*self._boxes, entry]
        try:
            yield box
        finally:
            self._boxes = [e for e in self._boxes if e is not entry]
