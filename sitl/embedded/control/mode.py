"""Flight modes and stick positions."""

from __future__ import annotations

from dataclasses import dataclass
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


@dataclass(frozen=True)
class RcInput:
    """Stick positions: -1 to 1, throttle 0 to 1."""

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    throttle: float = 0.0
