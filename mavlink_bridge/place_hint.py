"""MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003) to the localizer: the operator's position hint.

Sent to the autopilot, the same command sets the EKF's position. Sent to the localizer, it limits
the search and is never injected.
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.messages import PlaceHint

PLACE_HINT = int(mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE)
_DEFAULT_RADIUS_M = 100.0  # where the command gives no accuracy
_LEAST_RADIUS_M, _LARGEST_RADIUS_M = 10.0, 20_000.0
_GLOBAL_FRAMES = (
    mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_INT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
)


def place_of(message: Any) -> tuple[float, float, float] | None:
    """Latitude and longitude (degrees) and the last parameter of a COMMAND_INT, where both are 1e-7
    degrees, or of a COMMAND_LONG (to about a metre); None without a valid position, or in a local
    frame.
    """
    if message.get_type() == "COMMAND_INT":
        if message.frame not in _GLOBAL_FRAMES:  # x and y of a local frame are metres
            return None
        latitude, longitude, last = message.x * 1e-7, message.y * 1e-7, message.z
    else:
        latitude, longitude, last = message.param5, message.param6, message.param7
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0) or latitude == longitude == 0.0:
        return None
    return float(latitude), float(longitude), float(last)


def place_hint(message: Any) -> PlaceHint | None:
    """The hint of a COMMAND_INT or COMMAND_LONG; None without a position (`place_of`).

    param3: accuracy, 1 sigma in metres, limited to 10 to 20,000; 100 if not positive.
    """
    place = place_of(message)
    if place is None:
        return None
    accuracy = message.param3
    if not (math.isfinite(accuracy) and accuracy > 0.0):
        accuracy = _DEFAULT_RADIUS_M
    radius = min(max(accuracy, _LEAST_RADIUS_M), _LARGEST_RADIUS_M)
    return PlaceHint(place[0], place[1], float(radius))
