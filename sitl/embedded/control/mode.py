"""Flight modes."""

from __future__ import annotations

from enum import IntEnum


class Mode(IntEnum):
    """ArduCopter custom modes."""

    STABILIZE = 0
    AUTO = 3
    GUIDED = 4
    RTL = 6
    LAND = 9

    @property
    def needs_position(self) -> bool:
        """Whether the mode may only be entered with a position estimate."""
        return self in (Mode.AUTO, Mode.GUIDED, Mode.RTL)

    @property
    def armable(self) -> bool:
        """Whether the vehicle may be armed in it."""
        return self in (Mode.STABILIZE, Mode.GUIDED)
