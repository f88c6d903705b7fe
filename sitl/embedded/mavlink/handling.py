"""Shared by the message handlers: types, results, and positions in messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sitl.embedded.mavlink.server import SerialPort
from sitl.geodesy import Location

ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4  # MAV_RESULT
_GLOBAL_FRAMES_RELATIVE = (3, 6)
_GLOBAL_FRAMES = (0, 5, *_GLOBAL_FRAMES_RELATIVE)

Handler = Callable[[SerialPort, Any], None]
CommandHandler = Callable[[SerialPort, Any], int]


def location_of(
    home: Location | None, frame: int, x: int, y: int, altitude: float
) -> Location | None:
    """Location of a message's coordinates (degrees * 1e7, m) in a global MAV_FRAME. None for other
    frames, or without home.
    """
    if frame not in _GLOBAL_FRAMES or home is None:
        return None
    base = home.altitude_m if frame in _GLOBAL_FRAMES_RELATIVE else 0.0
    return Location(x / 1e7, y / 1e7, base + altitude)
