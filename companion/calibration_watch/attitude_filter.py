"""Estimates boresight and time offset from registered attitude, gimbal and autopilot.

A mounting, gimbal or compass error is a constant angle. The error of a time offset is the turn rate
times the delay.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.calibration_watch.observation import (
    AutopilotObservation,
    CalibrationEstimate,
    CalibrationObservation,
)
from localizer.geometry.pose import so3_log
from localizer.sensors.error_model import SENSORS
from mavlink_bridge.alerts.words import CalibrationError

Array = NDArray[np.float64]
AXES = (CalibrationError.YAW, CalibrationError.PITCH, CalibrationError.ROLL)
_LATE = 3  # index of the delay; before it the angles, rad
_SIGMAS = np.array([*np.radians([10.0, 5.0, 5.0]), 0.3])
_WALKS = np.array([*np.radians([0.15, 0.05, 0.05]), 0.006])  # per root second
_NOISE_RAD = np.radians([SENSORS.heading_step_deg, SENSORS.tilt_step_deg, SENSORS.tilt_step_deg])
_OUTLIER = 5.0  # sigmas
_ANEW = 4  # outliers in a row, after which what was learned is void
_TURNS_RADPS = 0.1
_LEVEL_TURN = 0.2  # below this horizontal part of the axis "forward" is the picture's top


class ErrorFilter:
    """Kalman filter that is updated by one scalar measurement after the other. sigmas: of the
    unknown states, which are zero at first.
    """

    def __init__(self, sigmas: Array) -> None:
        self._sigmas = sigmas
        self._x = np.zeros(len(sigmas))
        self._cov = np.diag(np.square(sigmas))

    def _correct(self, H: Array, innovation: float, sigma: float) -> bool:
        """Update with one measurement; False if it is an outlier, which is ignored."""
        PH = self._cov @ H
        S = float(H @ PH) + sigma**2
        if innovation**2 > _OUTLIER**2 * S:
            return False
        K = PH / S
        self._x = self._x + K * innovation
        self._cov = self._cov - np.outer(K, PH)
        self._cov = 0.5 * (self._cov + self._cov.T)
        return True

    def _loosen(self, *states: int) -> None:
        """Increase the variance of some states and remove their correlations; keep their values."""
        for i in states:
            self._cov[i, :] = self._cov[:, i] = 0.0
            self._cov[i, i] = self._sigmas[i] ** 2

    def _figure(self, at: int) -> CalibrationEstimate:
        return CalibrationEstimate(float(self._x[at]), float(np.sqrt(max(self._cov[at, at], 0.0))))


class AttitudeFilter(ErrorFilter):
    """Kalman filter of boresight and time offset. Takes observations in time order, a few times a
    second; one thread.
    """

    def __init__(self) -> None:
        super().__init__(_SIGMAS)
        self._outliers = 0

    @property
    def boresight_rad(self) -> tuple[CalibrationEstimate, CalibrationEstimate, CalibrationEstimate]:
        """Boresight error in yaw (about the vertical), pitch and roll: how vision's attitude is
        turned against that of gimbal and autopilot, about `level_axes`.
        """
        return self._figure(0), self._figure(1), self._figure(2)

    @property
    def late_s(self) -> CalibrationEstimate:
        """Delay of the frames' timestamps, s; positive: they are later than the exposures."""
        return self._figure(_LATE)

    def forget_time_offset(self) -> None:
        """Reset the time offset to unknown."""
        self._loosen(_LATE)

    def add(
        self, seen: CalibrationObservation, known: AutopilotObservation, seconds: float
    ) -> None:
        """Add a registered frame (`seen`), `seconds` after the one before, and the autopilot's data
        at its time (`known`). Without its attitude or turn rate nothing is learned. Four outliers
        in a row reset the angles, or in a turn the time offset.
        """
        self._cov = self._cov + np.diag(np.square(_WALKS) * min(seconds, 10.0))
        if known.ned_from_camera is None or known.turn is None:
            return
        axes = level_axes(known.ned_from_camera)
        off = axes @ so3_log(seen.ned_from_camera @ known.ned_from_camera.T)
        turn = axes @ known.turn
        agreed = True
        for i in range(3):
            H = np.zeros(4)
            H[i], H[_LATE] = 1.0, -turn[i]
            agreed &= self._correct(H, float(off[i] - H @ self._x), _NOISE_RAD[i])
        self._outliers = 0 if agreed else self._outliers + 1
        if self._outliers >= _ANEW:
            # In a turn a stream that began to lag looks like this, else a gimbal that was knocked.
            lags = float(np.linalg.norm(known.turn)) > _TURNS_RADPS
            self._loosen(*([_LATE] if lags else [0, 1, 2]))
            self._outliers = 0


def level_axes(ned_from_camera: Array) -> Array:
    """Axes (3, 3) of a camera, made level, as rows in NED: down (yaw), right (pitch), forward
    (roll). Forward is where it looks; if it looks nearly down or up, where the image's top is.
    """
    forward = ned_from_camera[:, 2] * np.array([1.0, 1.0, 0.0])
    if np.linalg.norm(forward) < _LEVEL_TURN:
        forward = -ned_from_camera[:, 1] * np.array([1.0, 1.0, 0.0])
    norm = float(np.linalg.norm(forward))
    forward = forward / norm if norm > 1e-6 else np.array([1.0, 0.0, 0.0])
    down = np.array([0.0, 0.0, 1.0])
    return np.stack([down, np.cross(down, forward), forward])
