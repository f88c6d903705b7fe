"""Positions from the companion (vision, odometry, GPS_INPUT), processed as ArduPilot does."""

from __future__ import annotations

from collections import deque
from math import isnan, radians
from typing import Any, Protocol

import numpy as np

from sitl.embedded.ekf.estimator import Estimator
from sitl.embedded.ekf.measurements import ExternalPosition, ExternalVelocity, GpsData
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.rotation import euler, matrix, quaternion

_VISION_TIMEOUT_MS = 300
_LEAST_DELTA_US = 12_000  # one step of EKF3 (EKF_TARGET_DT)
_GPS_TIMEOUT_MS = 4000
_GPS_MAX_GAP_MS = 215
_GPS_MAVLINK = 14
_GPS_DEFAULT_DELAY_MS = 200
_LOCAL_FRD, _BODY_FRD = 20, 12
# GPS_INPUT_IGNORE_FLAGS
_IGNORE_HDOP, _IGNORE_HORIZONTAL_SPEED, _IGNORE_VERTICAL_SPEED, _IGNORE_SPEED_ACCURACY = (
    2,
    8,
    16,
    32,
)
_IGNORE_HORIZONTAL_ACCURACY = 64
_NO_HDOP = 99.99


class Clock(Protocol):
    """Converts a sender's timestamps."""

    def correct(self, remote_us: int, local_us: int) -> int:
        """The time of a message's timestamp, µs since boot; local_us: of its arrival."""
        ...


class ExternalNavInput:
    """Handles the companion's position messages: vision, odometry and GPS_INPUT."""

    def __init__(self, parameters: Parameters, estimator: Estimator) -> None:
        self._parameters = parameters
        self._estimator = estimator
        self._last_vision_ms = -1_000_000
        self._reset_counter: int | None = None
        self._gps_times: deque[int] = deque(maxlen=10)
        self._gps_fix_type = 0
        self.gps: GpsData | None = None
        self.receiver_has_fix = False  # of the simulated GPS1; GPS2 waits until it has lost it

    # --- vision ------------------------------------------------------------------------------

    def healthy(self, now_ms: int) -> bool:
        """Whether a vision message arrived in the last 300 ms."""
        return now_ms - self._last_vision_ms < _VISION_TIMEOUT_MS

    def vision(self, message: Any, clock: Clock, now_ms: int) -> None:
        """Take VISION_POSITION_ESTIMATE or GLOBAL_VISION_POSITION_ESTIMATE; both are read as local
        positions. VISO_TYPE 0 ignores them.
        """
        if self._parameters["VISO_TYPE"] == 0:
            return
        angles = (message.roll, message.pitch, message.yaw)
        yaw = None
        if not any(isnan(a) for a in angles):
            yaw = euler(quaternion(*angles))[2]
        # The message carries no quality: any VISO_QUAL_MIN above 0 refuses it.
        stamp = clock.correct(message.usec, now_ms * 1000) // 1000
        covariance = _covariance(message.covariance)
        self._pose(message, yaw=yaw, errors=covariance, stamp_ms=stamp, now_ms=now_ms, quality=0)

    def odometry(self, message: Any, clock: Clock, now_ms: int) -> None:
        """Take ODOMETRY in LOCAL_FRD with velocity in BODY_FRD; other frames are ignored."""
        if self._parameters["VISO_TYPE"] == 0:
            return
        if (message.frame_id, message.child_frame_id) != (_LOCAL_FRD, _BODY_FRD):
            return
        stamp = clock.correct(message.time_usec, now_ms * 1000) // 1000
        q = np.array(message.q, dtype=np.float64)
        known = bool(np.all(np.isfinite(q)) and np.linalg.norm(q) > 0.1)
        yaw = euler(q)[2] if known else None
        covariance = _covariance(message.pose_covariance)
        taken = self._pose(
            message,
            yaw=yaw,
            errors=covariance,
            stamp_ms=stamp,
            now_ms=now_ms,
            quality=message.quality,
        )
        if not taken:
            return
        if known:
            n, e, d = matrix(q) @ np.array([message.vx, message.vy, message.vz])
            sigma = self._parameters["VISO_VEL_M_NSE"]
            velocity = ExternalVelocity((float(n), float(e), float(d)), sigma)
            self._estimator.add_external_velocity(velocity, stamp)

    def position_delta(self, message: Any, now_ms: int) -> None:
        """Take VISION_POSITION_DELTA as a velocity, stamped with its arrival time.

        VISO_TYPE 0 ignores the message. Every other message marks vision as healthy. The EKF's own
        attitude rotates the position delta from body axes to NED. The sigma falls linearly from
        EK3_VIS_VERR_MAX at confidence 0 to EK3_VIS_VERR_MIN at 100. The angle delta is not used. A
        delta over less than 12 ms gives no velocity, as in ArduPilot.
        """
        p = self._parameters
        if p["VISO_TYPE"] == 0:
            return
        self._last_vision_ms = now_ms
        if message.time_delta_usec < _LEAST_DELTA_US:
            return
        moved = matrix(self._estimator.output[0:4]) @ np.array(message.position_delta)
        n, e, d = moved / (message.time_delta_usec * 1e-6)
        least, most = p["EK3_VIS_VERR_MIN"], p["EK3_VIS_VERR_MAX"]
        sigma = most + (least - most) * 0.01 * message.confidence
        velocity = ExternalVelocity((float(n), float(e), float(d)), sigma, is_delta=True)
        self._estimator.add_external_velocity(velocity, now_ms)

    def _pose(
        self,
        message: Any,
        *,
        yaw: float | None,
        errors: tuple[float, float],
        stamp_ms: int,
        now_ms: int,
        quality: int,
    ) -> bool:
        p = self._parameters
        self._last_vision_ms = now_ms
        if quality < p["VISO_QUAL_MIN"]:
            return False
        scale = p["VISO_SCALE"]
        reset = self._reset_counter is not None and message.reset_counter != self._reset_counter
        # VISO_POS is where the camera sits, forward, right, down of the IMU.
        camera = matrix(self._estimator.output[0:4]) @ [p[f"VISO_POS_{axis}"] for axis in "XYZ"]
        north, east, down = scale * np.array([message.x, message.y, message.z]) - camera
        fix = ExternalPosition(
            (float(north), float(east), float(down)),
            min(max(errors[0], p["VISO_POS_M_NSE"]), 100.0),
            yaw,
            min(max(errors[1], p["VISO_YAW_M_NSE"], radians(5.0)), 1.5),
            reset,
        )
        if self._estimator.add_external(fix, stamp_ms):
            self._reset_counter = message.reset_counter
        return True

    # --- GPS_INPUT ---------------------------------------------------------------------------

    def gps_fix(self, now_ms: int) -> bool:
        """Whether the newest GPS_INPUT is fresh and has a 3D fix."""
        fresh = bool(self._gps_times) and now_ms - self._gps_times[-1] < _GPS_TIMEOUT_MS
        return fresh and self._gps_fix_type >= 3

    def gps_healthy(self, now_ms: int) -> bool:
        """Whether the mean interval between fixes is at most 215 ms."""
        times = self._gps_times
        if len(times) < 3 or now_ms - times[-1] > 2 * _GPS_MAX_GAP_MS:
            return False
        return (times[-1] - times[0]) / (len(times) - 1) <= _GPS_MAX_GAP_MS

    def gps_input(self, message: Any, clock: Clock, now_ms: int) -> None:
        """Take GPS_INPUT of gps_id 0 or 1 if GPS1_TYPE or GPS2_TYPE, respectively, is 14; gps_id 1
        is fused only while the simulated receiver has no fix.
        """
        receiver = f"GPS{message.gps_id + 1}"
        if message.gps_id > 1 or self._parameters[f"{receiver}_TYPE"] != _GPS_MAVLINK:
            return
        flags = message.ignore_flags
        self._gps_times.append(now_ms)
        self._gps_fix_type = message.fix_type
        if message.fix_type < 3:
            self.gps = None
            return
        stamp = now_ms
        if message.time_week > 0:
            remote = (message.time_week * 604_800_000 + message.time_week_ms) * 1000
            stamp = clock.correct(remote, now_ms * 1000) // 1000
        self.gps = GpsData(
            message.lat / 1e7,
            message.lon / 1e7,
            message.alt,
            None if flags & _IGNORE_HORIZONTAL_SPEED else (message.vn, message.ve),
            None if flags & _IGNORE_VERTICAL_SPEED else message.vd,
            0.0 if flags & _IGNORE_HORIZONTAL_ACCURACY else message.horiz_accuracy,
            0.0 if flags & _IGNORE_SPEED_ACCURACY else message.speed_accuracy,
            message.satellites_visible,
            _NO_HDOP if flags & _IGNORE_HDOP else message.hdop,
            radians(message.yaw / 100.0) if message.yaw else None,
        )
        if message.gps_id == 1 and self.receiver_has_fix:
            return
        delay = int(self._parameters[f"{receiver}_DELAY_MS"]) or _GPS_DEFAULT_DELAY_MS
        self._estimator.add(self.gps, stamp - delay)


def _covariance(values: Any) -> tuple[float, float]:
    """(position sigma m, angle sigma rad) of an upper triangle, by ArduPilot 4.7's formula."""
    c = [float(v) for v in values]
    if isnan(c[0]):
        return 0.0, 0.0
    position = np.cbrt(c[0] ** 2 + c[6] ** 2 + c[11] ** 2)
    angle = np.cbrt(c[15] ** 2 + c[18] ** 2 + c[20] ** 2)
    return (
        float(position) if np.isfinite(position) else float("nan"),
        float(angle) if np.isfinite(angle) else 0.0,
    )
