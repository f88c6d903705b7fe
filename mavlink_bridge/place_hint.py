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
GLOBAL_FRAMES = (
    mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_INT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
)


def place_hint(message: Any) -> PlaceHint | None:
    """The hint of a COMMAND_INT or COMMAND_LONG; None if it has no valid position or a local frame.

    param3: accuracy, 1 sigma in metres, limited to 10 to 20,000; 100 if not positive. param5,
    param6: latitude and longitude, as 1e-7 degrees in COMMAND_INT, as degrees (to about a metre) in
    COMMAND_LONG.
    """
    if message.get_type() == "COMMAND_INT":
        if message.frame not in GLOBAL_FRAMES:  # x and y of a local frame are metres
            return None
        latitude, longitude = message.x * 1e-7, message.y * 1e-7
    else:
        latitude, longitude = message.param5, message.param6
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0) or latitude == longitude == 0.0:
        return None
    accuracy = message.param3
    if not (math.isfinite(accuracy) and accuracy > 0.0):
        accuracy = _DEFAULT_RADIUS_M
    radius = min(max(accuracy, _LEAST_RADIUS_M), _LARGEST_RADIUS_M)
    return PlaceHint(float(latitude), float(longitude), float(radius))
