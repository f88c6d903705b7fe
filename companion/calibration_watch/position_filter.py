"""Estimates boresight and time offset from vision's attitude, focal length from its position.

A focal length that is too long by a share e puts the camera e times the ground distance too far
back along its optical axis; this error changes with axis and height, and a map offset does not. A
delay tau puts the vehicle v tau behind. One Kalman filter compares with the IMU, the EKF's position
while it uses GNSS, and the heights of GNSS and barometer; their biases are states. Data that depend
on injected positions are not used.

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

AXES = (CalibrationError.YAW, CalibrationError.PITCH, CalibrationError.ROLL)
_LATE = 3  # index of the delay; before it the angles, rad
_ATTITUDE_SIGMAS = np.array([*np.radians([10.0, 5.0, 5.0]), 0.3])
_ATTITUDE_WALKS = np.array([*np.radians([0.15, 0.05, 0.05]), 0.006])  # per root second
_NOISE_RAD = np.radians([SENSORS.heading_step_deg, SENSORS.tilt_step_deg, SENSORS.tilt_step_deg])
_OUTLIER = 5.0  # sigmas
_ATTITUDE_ANEW = 4  # outliers in a row, after which what was learned is void
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
        super().__init__(_ATTITUDE_SIGMAS)
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
        self._cov = self._cov + np.diag(np.square(_ATTITUDE_WALKS) * min(seconds, 10.0))
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
        if self._outliers >= _ATTITUDE_ANEW:
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


Array = NDArray[np.float64]

# States, by index: position, velocity, acceleration bias (north, east); map against GNSS (north,
# east); focal share; lateness; heights of GNSS and of the barometer against vision's; the
# barometer's scale (a warm day lifts it by per cents).
_P, _V, _A, _B, _F, _T, _U, _C, _S = 0, 2, 4, 6, 8, 9, 10, 11, 12
_SIZE = 13
_SIGMAS = np.array([1e3, 1e3, 15, 15, 0.3, 0.3, 2.0, 2.0, 0.03, 0.15, 100.0, 100.0, 0.04])
# Random walks, per root second: tilt errors of turns; GNSS wander; the barometer's drift; a clock.
_WALKS = np.array([0, 0, 0, 0, 0.02, 0.02, 0.15, 0.15, 3e-4, 0.006, 0.25, 0.15, 1e-4])
_VISION_M = 0.25  # errors of vision that last longer than from one sighting to the next
_GNSS_M, _GNSS_HEIGHT_M, _PRESSURE_M = 0.5, 1.0, 0.5
_ANEW = 8  # outliers in a row, after which the motion is unknown
_SLOW_MPS = 1.0
_ZOOMED = 3  # sightings in a row that contradict what was known: the lens may be another now


class PositionFilter(ErrorFilter):
    """Kalman filter of focal length and time offset. Takes observations in time order, a few times
    a second; one thread.
    """

    def __init__(self) -> None:
        super().__init__(_SIGMAS)
        self._outliers = 0
        self._contradicted = 0
        self._height0: float | None = None
        self._zeros: dict[int, float] = {}

    @property
    def focal(self) -> CalibrationEstimate:
        """Relative error of the focal length; positive: too long."""
        return self._figure(_F)

    @property
    def late_s(self) -> CalibrationEstimate:
        """Delay of the frames' timestamps, s; positive: they are later than the exposures."""
        return self._figure(_T)

    def forget_motion(self) -> None:
        """Reset position, velocity and IMU bias to unknown, after a gap or a jump of vision."""
        self._forget(_P, _P + 1, _V, _V + 1, _A, _A + 1)

    def forget_time_offset(self) -> None:
        """Reset the time offset to unknown."""
        self._forget(_T)

    def predict(self, moved: Array, faster: Array, seconds: float) -> None:
        """Predict with the IMU over `seconds`. moved: displacement beyond that of the velocity, m;
        faster: change of velocity, m/s; (2,) each, north and east.
        """
        h = seconds
        transition = np.eye(_SIZE)
        noise = np.diag(np.square(_WALKS) * h)
        q = SENSORS.imu_noise**2
        for axis in (0, 1):
            p, v, a = _P + axis, _V + axis, _A + axis
            transition[p, v], transition[p, a], transition[v, a] = h, -0.5 * h * h, -h
            noise[p, p] += h**3 / 3.0 * q
            noise[p, v] += h * h / 2.0 * q
            noise[v, p] += h * h / 2.0 * q
            noise[v, v] += h * q
        self._x = transition @ self._x
        self._x[_P : _P + 2] += moved
        self._x[_V : _V + 2] += faster
        self._cov = transition @ self._cov @ transition.T + noise

    def add(
        self,
        place: Array,
        seen: CalibrationObservation,
        known: AutopilotObservation,
        climb_mps: float,
    ) -> None:
        """Correct the state, predicted to the observation's time, by one observation (`seen`) and
        the autopilot's data at its time (`known`).
        place: `seen.place` as north and east (2,), m from a point that stays the same; climb_mps:
        the vehicle's, up positive.
        """
        axis = seen.ned_from_camera[:, 2]
        behind = seen.depth_m * axis  # by which a share of 1 would put the camera back
        # Heights first: they tell a lens from a lag, which is all horizontal.
        contradicted = not self._heights(seen, known, behind[2], climb_mps)
        agreed = True
        velocity = self._x[_V : _V + 2].copy()
        if np.hypot(*velocity) < _SLOW_MPS:
            velocity[:] = 0.0  # who stands tells no lateness: the filter would invent a velocity
        for i in (0, 1):
            H = np.zeros(_SIZE)
            H[_P + i], H[_V + i] = 1.0, -self._x[_T] if velocity.any() else 0.0
            H[_F], H[_T] = -behind[i], -velocity[i]
            # v tau is bilinear: its value is subtracted once, its two slopes are in H.
            predicted = float(H @ self._x) + self._x[_T] * velocity[i]
            sigma = float(np.hypot(seen.sigma_m, _VISION_M))
            agreed &= self._correct(H, place[i] - predicted, sigma)
        self._outliers = 0 if agreed else self._outliers + 1
        if self._outliers >= _ANEW:
            self.forget_motion()
            self._forget(_T)  # a stream that began to lag looks like this
            self._outliers = 0
        if known.north_east_m is not None:
            for i in (0, 1):
                H = np.zeros(_SIZE)
                H[_P + i] = H[_B + i] = 1.0
                measured = place[i] + known.north_east_m[i]
                agreed &= self._correct(H, measured - float(H @ self._x), _GNSS_M)
        self._contradicted = self._contradicted + 1 if contradicted or not agreed else 0
        if self._contradicted >= _ZOOMED:
            self._loosen(_F)
            self._contradicted = 0

    def _heights(
        self,
        seen: CalibrationObservation,
        known: AutopilotObservation,
        down_m: float,
        climb_mps: float,
    ) -> bool:
        """Compare heights. Vision's height is `focal x down_m` too large, and lags a climb by the
        time offset. False if the other heights contradict the estimate.
        """
        agreed = True
        height = seen.place[2]
        if self._height0 is None:
            self._height0 = height
        others = (
            (_U, known.gnss_height_m, _GNSS_HEIGHT_M),
            (_C, known.pressure_height_m, _PRESSURE_M),
        )
        for state, other, sigma in others:
            if other is None:
                continue
            difference = height - other
            zero = self._zeros.setdefault(state, difference)
            H = np.zeros(_SIZE)
            H[_F], H[_T], H[state] = down_m, -climb_mps, 1.0
            if state == _C:
                H[_S] = height - self._height0
            agreed &= self._correct(H, difference - zero - float(H @ self._x), sigma)
        return agreed

    def _forget(self, *states: int) -> None:
        self._loosen(*states)
        self._x[list(states)] = 0.0
