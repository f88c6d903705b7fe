"""A registered frame as evidence of the camera's focal length, boresight and time offset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
