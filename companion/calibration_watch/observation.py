"""A registered frame as evidence of calibration errors, and the distances that scale their effect.

Registered frames give distance to the ground and width of the view. The height above take-off does
not: the terrain may be lower or higher, and a lens may zoom.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


Array = NDArray[np.float64]


@dataclass(frozen=True)
class CalibrationObservation:
    """Pose of one registered frame, and the autopilot's data of the same time.

    place: latitude, longitude (degrees) and height above the ellipsoid (m) of the vehicle; sigma_m:
    horizontal, 1 sigma. ned_from_camera: (3, 3), OpenCV axes. depth_m: distance of the ground along
    the optical axis, from the map. horizontal_fov_deg: at this frame's zoom.
    """

    time_ns: int
    place: tuple[float, float, float]
    sigma_m: float
    ned_from_camera: Array
    depth_m: float
    horizontal_fov_deg: float


@dataclass(frozen=True)
class AutopilotObservation:
    """The autopilot's data at the time of a frame; None if unknown.

    ned_from_camera: (3, 3) by gimbal and attitude; turn: its rotation vector (3,) over a second,
    NED, rad. north_east_m: the EKF's position on GNSS, relative to the observation. gnss_height_m,
    pressure_height_m: used for changes only.
    """

    ned_from_camera: Array | None
    turn: Array | None
    north_east_m: tuple[float, float] | None
    gnss_height_m: float | None
    pressure_height_m: float | None


@dataclass(frozen=True)
class CalibrationEstimate:
    """An estimate and its standard deviation."""

    value: float
    sigma: float

    def exceeds(self, limit: float) -> bool:
        """Whether the value's size is above the limit and above four sigmas."""
        return abs(self.value) > limit and abs(self.value) > 4.0 * self.sigma

    def is_within(self, limit: float) -> bool:
        """Whether the value's size plus two sigmas is below the limit."""
        return abs(self.value) + 2.0 * self.sigma < limit
