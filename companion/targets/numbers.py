"""The numbers that targets have in MAVLink."""

from __future__ import annotations


class TargetNumbers:
    """A small stable number for each target's name, in the order in which they were first seen."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    def of(self, name: str) -> int:
        """The number of the target of that name."""
        return self._numbers.setdefault(name, len(self._numbers))
