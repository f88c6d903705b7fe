"""Positions from the companion, taken as PX4 takes them."""

from __future__ import annotations

from collections import deque
from math import isfinite, sqrt
from typing import Any

import numpy as np

from sitl.embedded.ekf.injection import Clock, ExternalNavInput
from sitl.embedded.ekf.measurements import ExternalPosition, ExternalVelocity
from sitl.embedded.physics.rotation import euler, matrix
from sitl.geodesy import Location

_LOCAL_NED, _LOCAL_FRD, _BODY_FRD = 1, 20, 12
_EXCHANGES = 20


class RemoteClock:
    """Offset of a sender's clock, from the fastest of the last TIMESYNC exchanges. Times in µs."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[int, int]] = deque(maxlen=_EXCHANGES)

    def add_exchange(self, remote_us: int, asked_us: int, now_us: int) -> None:
        """Add a TIMESYNC answer: its tc1 (sender's clock), its ts1 (own clock when asked), and the
        own clock at its arrival, all µs.
        """
        middle = (asked_us + now_us) // 2
        self._exchanges.append((now_us - asked_us, remote_us - middle))

    def correct(self, remote_us: int, local_us: int) -> int:
        """Convert a sender's timestamp to µs since boot; local_us before the first exchange."""
        if not self._exchanges:
            return local_us
        return remote_us - min(self._exchanges)[1]


class Px4PositionInput(ExternalNavInput):
    """Handles PX4's position messages."""

    def vision(self, message: Any, clock: Clock, now_ms: int) -> None:
        """Take VISION_POSITION_ESTIMATE, NED."""
        stamp = clock.correct(message.usec, now_ms * 1000) // 1000
        self._position(message, message.covariance, stamp, now_ms)

    def odometry(self, message: Any, clock: Clock, now_ms: int) -> None:
        """Take ODOMETRY in LOCAL_NED or LOCAL_FRD; the axes of LOCAL_FRD count as north and east.
        Other frames, and a quality below EKF2_EV_QMIN, are ignored. Of the velocity only one in
        BODY_FRD, turned by `q`, is used; the heading is not.
        """
        p = self._parameters
        stamp = clock.correct(message.time_usec, now_ms * 1000) // 1000
        if message.frame_id not in (_LOCAL_NED, _LOCAL_FRD):
            return
        if message.quality < p["EKF2_EV_QMIN"]:
            return
        self._position(message, message.pose_covariance, stamp, now_ms)
        body = np.array([message.vx, message.vy, message.vz])
        if message.child_frame_id != _BODY_FRD or not np.all(np.isfinite(body)):
            return
        n, e, d = matrix(np.array(message.q, dtype=np.float64)) @ body
        variance = message.velocity_covariance[0]
        sigma = sqrt(variance) if isfinite(variance) and variance > 0 else 0.0
        velocity = ExternalVelocity((float(n), float(e), float(d)), max(sigma, p["EKF2_EVV_NOISE"]))
        self._estimator.add(velocity, stamp - int(p["EKF2_EV_DELAY"]))

    def global_position(self, message: Any, clock: Clock, now_ms: int) -> None:
        """Take GLOBAL_POSITION_SENSOR with id EKF2_AGP0_ID; the first sets a missing origin."""
        p, estimator = self._parameters, self._estimator
        if message.id == 0 or message.id != p["EKF2_AGP0_ID"] or not int(p["EKF2_AGP0_CTRL"]) & 1:
            return
        where = Location(message.lat / 1e7, message.lon / 1e7, message.alt)
        if estimator.origin is None:
            estimator.set_origin(where)
        if estimator.origin is None or not isfinite(message.eph):
            return
        taken_us = message.time_usec - message.processing_time
        stamp = clock.correct(taken_us, now_ms * 1000) // 1000
        sigma = max(message.eph, p["EKF2_AGP0_NOISE"], 0.01)
        fix = ExternalPosition(
            estimator.origin.ned_of(where), sigma, None, 0.0, False, is_global=True
        )
        self._last_vision_ms = now_ms
        estimator.add(fix, stamp - int(p["EKF2_AGP0_DELAY"]))

    def _position(self, message: Any, covariance: Any, stamp_ms: int, now_ms: int) -> None:
        p = self._parameters
        place = (message.x, message.y, message.z)
        if not all(isfinite(c) for c in place):
            return
        reported = [float(covariance[i]) for i in (0, 6)]
        noise = p["EKF2_EVP_NOISE"]
        sigma = noise
        if p["EKF2_EV_NOISE_MD"] == 0 and all(isfinite(v) and v > 0 for v in reported):
            sigma = max(sqrt(max(reported)), noise)
        camera = matrix(self._estimator.output[0:4]) @ [p[f"EKF2_EV_POS_{axis}"] for axis in "XYZ"]
        north, east, down = (float(place[i] - camera[i]) for i in range(3))
        reset = self._reset_counter is not None and message.reset_counter != self._reset_counter
        self._reset_counter, self._last_vision_ms = message.reset_counter, now_ms
        yaw = euler(self._estimator.output[0:4])[2]
        fix = ExternalPosition((north, east, down), sigma, yaw, 1.0, reset)
        self._estimator.add(fix, stamp_ms - int(p["EKF2_EV_DELAY"]))
