"""Numbers by which MAVLink messages identify targets."""

from __future__ import annotations

import threading
from itertools import cycle

from companion.targets.detections import clicked_number
from mavlink_bridge.shared import CLICKED, FURTHER_CLICKS

# Below and above are the clicks, which bring their numbers with them.
_DETECTED = range(CLICKED.stop, FURTHER_CLICKS)
_MOST = 256  # names; many times as many as are followed at a time


class TargetNumbers:
    """Gives each target's name a number: that of its click, or the next free one for detections.

    Numbers are unique; one is reused only after a million others. The 256 newest names are
    remembered.
    """

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._free = cycle(_DETECTED)
        self._lock = threading.Lock()

    def number_of(self, name: str) -> int:
        """The number of the target of that name; a new name gets the next free one."""
        if (clicked := clicked_number(name)) is not None:
            return clicked
        with self._lock:
            number = self._numbers.pop(name, None)
            if number is None:
                taken = self._numbers.values()
                number = next(n for n in self._free if n not in taken)
                if len(self._numbers) >= _MOST:
                    del self._numbers[next(iter(self._numbers))]
            self._numbers[name] = number  # at the end: the newest
            return number
