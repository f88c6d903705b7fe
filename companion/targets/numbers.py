"""The numbers that targets have in MAVLink."""

from __future__ import annotations

from companion.targets.detections import CLICKED

_FIRST_DETECTED = 1001  # below are the clicks, which bring their numbers with them


class TargetNumbers:
    """A number for each target's name: a click's own, or the next one of what was detected."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    def of(self, name: str) -> int:
        """The number of the target of that name."""
        if name.startswith(CLICKED):
            return int(name[len(CLICKED) :])
        return self._numbers.setdefault(name, _FIRST_DETECTED + len(self._numbers))
