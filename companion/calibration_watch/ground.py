"""Distance to the ground and width of the view, which scale the effect of calibration errors.

Registered frames give both. The height above take-off does not: the terrain may be lower or higher,
and a lens may zoom.
"""

from __future__ import annotations

import math

from companion.calibration_watch.observation import CalibrationObservation
from mavlink_bridge.messages import VehicleState

UNKNOWN_HEIGHT_M = 120.0  # most may fly no higher
_BELOW_M = -5.0  # of a barometer on the ground
_WIDTH_HEIGHT_M = 100.0  # where nothing is known: an assumption too high finds a still picture late
_HOLDS_NS = 2_000_000_000  # a view, for a lens and a height that change
_LONG_AGO_NS = 10_000_000_000  # the ground below may be another since


class GroundView:
    """Tracks ground distance and width of the view from registered frames. horizontal_fov_deg: used
    for observations without one.
    """

    def __init__(self, horizontal_fov_deg: float) -> None:
        self._fov_deg = horizontal_fov_deg
        self._newest: CalibrationObservation | None = None

    def add(self, observation: CalibrationObservation) -> None:
        """Set the newest registered frame that was accepted against the map."""
        self._newest = observation

    def height_m(self, state: VehicleState, now_ns: int) -> float | None:
        """Height above the ground, m: the larger of that above take-off (`state`) and that by the
        newest registered frame; None if neither is known.

        now_ns: time of the query; observations from long before it are not used.
        """
        relative_m, newest = state.altitude_relative_m, self._newest
        known = [] if relative_m is None or relative_m < _BELOW_M else [max(relative_m, 0.0)]
        if newest is not None and now_ns - newest.time_ns < _LONG_AGO_NS:
            known.append(max(newest.depth_m * float(newest.ned_from_camera[2, 2]), 0.0))
        return max(known, default=None)

    def width_m(self, state: VehicleState, now_ns: int) -> float:
        """Width of the ground that the frame at now_ns shows, m. If the height above ground is
        unknown, it is taken as 100 m.
        """
        newest = self._newest
        if newest is not None and now_ns - newest.time_ns < _HOLDS_NS:
            return newest.depth_m * _width_ratio(newest.horizontal_fov_deg)
        height_m = self.height_m(state, now_ns)
        return (_WIDTH_HEIGHT_M if height_m is None else height_m) * _width_ratio(self._fov_deg)


def _width_ratio(fov_deg: float) -> float:
    """Width of the view divided by its distance, at this horizontal field of view."""
    return 2.0 * math.tan(math.radians(fov_deg) / 2.0)
