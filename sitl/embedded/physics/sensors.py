"""Sensor models: IMU with bias and random walk, barometer, compass, GNSS receiver with lag.

Noise levels are those of a good consumer autopilot: dead reckoning over a 5 s gap stays below one
metre, as measured in ArduPilot SITL. One seeded random generator.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from math import exp, sqrt

import numpy as np

from sitl.embedded.physics.dynamics import ATTITUDE, POSITION, SUBSTEPS, TICK_S, VELOCITY
from sitl.embedded.physics.rotation import Array, euler, wrap_pi

_GYRO_NOISE = 0.01  # rad/s per 400 Hz sample
_ACCEL_NOISE = 0.4  # m/s²
_GYRO_BIAS, _GYRO_WALK = 0.0008, 1e-5  # rad/s at start; rad/s/sqrt(s)
_ACCEL_BIAS, _ACCEL_WALK = 0.03, 1e-3  # m/s²; m/s²/sqrt(s)
_BARO_NOISE, _BARO_WALK = 0.12, 0.015  # m; m/sqrt(s)
_COMPASS_NOISE, _COMPASS_OFFSET = 0.02, 0.01  # rad of heading
_GPS_PERIOD_S = 0.2
_GPS_WANDER_S = 60.0  # correlation time of the slowly moving part
_GPS_HORIZONTAL, _GPS_VERTICAL, _GPS_WHITE, _GPS_SPEED = 0.25, 0.25, 0.08, 0.05


@dataclass(frozen=True)
class GpsSample:
    """A GNSS solution: NED metres about home and m/s, valid at time_s; accuracies in m and m/s."""

    time_s: float
    position: Array
    velocity: Array
    horizontal_accuracy: float
    vertical_accuracy: float
    speed_accuracy: float
    satellites: int = 10
    fix: bool = True


class Jammer:
    """Output of a jammed receiver: first no fix, then jumping fixes with wrong accuracies.

    Rates and sizes are those of ArduPilot's SIM_GPS1_JAM.
    """

    def __init__(self, rng: np.random.Generator, clean: GpsSample) -> None:
        self._rng = rng
        self._silent_until_s = clean.time_s + float(rng.uniform(1.0, 6.0))
        self._position = clean.position.copy()
        self._velocity = clean.velocity.copy()
        self._accuracies = (0.5, 0.8, 0.3)
        self._satellites, self._fix = 0, False

    def distort(self, clean: GpsSample) -> GpsSample:
        """The jammed sample that replaces the clean one. Called for each sample of the receiver."""
        if clean.time_s < self._silent_until_s:
            return replace(clean, satellites=0, fix=False)
        rng = self._rng
        if self._changes(3.0):
            self._satellites = int(rng.integers(2, 17))
            self._fix = self._satellites >= 4 and bool(rng.integers(2))
        if self._changes(0.5):
            self._velocity[2] = rng.uniform(-400, 400)
        if self._changes(0.8):
            self._velocity[0:2] = rng.uniform(-400, 400, 2)
        if self._changes(1.1):
            self._position[0:2] += rng.uniform(-200, 200, 2)
        if self._changes(3.0):
            h, v, s = rng.uniform(0, 1, 3) * (300.0, 300.0, 50.0)
            self._accuracies = (float(h), float(v), float(s))
        return GpsSample(
            clean.time_s,
            self._position.copy(),
            self._velocity.copy(),
            *self._accuracies,
            self._satellites,
            self._fix,
        )

    def _changes(self, hertz: float) -> bool:
        return bool(self._rng.uniform() < hertz * _GPS_PERIOD_S)


class Sensors:
    """All sensors of one vehicle. x: its true state (17,)."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self.imu_bias = np.concatenate(
            [self._rng.normal(0, _GYRO_BIAS, 3), self._rng.normal(0, _ACCEL_BIAS, 3)]
        )
        self._walk = np.repeat([_GYRO_WALK, _ACCEL_WALK], 3) * sqrt(TICK_S)
        self._scale = np.repeat([_GYRO_NOISE, _ACCEL_NOISE], 3)
        self._baro_drift = 0.0
        self._compass_offset = float(self._rng.normal(0, _COMPASS_OFFSET))
        self._gps_sigma = np.array([_GPS_HORIZONTAL, _GPS_HORIZONTAL, _GPS_VERTICAL])
        self._gps_wander = self._rng.normal(0, 1, 3) * self._gps_sigma
        self._gps_pending: deque[GpsSample] = deque()
        self._gps_next_s = 0.0
        self._jammer: Jammer | None = None

    def imu_noise(self) -> Array:
        """Noise of the next tick's samples (SUBSTEPS, 6); the biases take a step too."""
        draw = self._rng.standard_normal((SUBSTEPS + 1, 6))
        self.imu_bias += draw[SUBSTEPS] * self._walk
        noise: Array = draw[:SUBSTEPS] * self._scale
        return noise

    def barometer(self, x: Array, dt: float) -> float:
        """Height above the home plane in metres, dt seconds after the last reading."""
        self._baro_drift += float(self._rng.normal()) * _BARO_WALK * sqrt(dt)
        return float(-x[POSITION + 2] + self._baro_drift + self._rng.normal() * _BARO_NOISE)

    def compass(self, x: Array) -> float:
        """Heading from true north in radians."""
        yaw = euler(x[ATTITUDE : ATTITUDE + 4])[2]
        return wrap_pi(yaw + self._compass_offset + float(self._rng.normal()) * _COMPASS_NOISE)

    def gps(
        self,
        time_s: float,
        x: Array,
        jammed: bool,
        glitch: Array,
        lag_s: float = 0.1,
        accuracy_m: float = 0.5,
    ) -> GpsSample | None:
        """The GNSS solution that arrives at time_s; None if none arrives. It is lag_s old and
        states accuracy_m.

        x: true state (17,). glitch: (3,) NED metres added to its position. jammed: replace it by a
        jammed one.
        """
        if time_s >= self._gps_next_s:
            self._gps_next_s = time_s + _GPS_PERIOD_S
            self._gps_pending.append(self._measure(time_s, x, jammed, glitch, accuracy_m))
        if self._gps_pending and time_s >= self._gps_pending[0].time_s + lag_s:
            return self._gps_pending.popleft()
        return None

    def _measure(
        self, time_s: float, x: Array, jammed: bool, glitch: Array, accuracy_m: float
    ) -> GpsSample:
        keep = exp(-_GPS_PERIOD_S / _GPS_WANDER_S)
        draw = self._rng.standard_normal(9)
        step = sqrt(1 - keep**2) * self._gps_sigma * draw[0:3]
        self._gps_wander = keep * self._gps_wander + step
        clean = GpsSample(
            time_s,
            x[POSITION : POSITION + 3] + glitch + self._gps_wander + _GPS_WHITE * draw[3:6],
            x[VELOCITY : VELOCITY + 3] + _GPS_SPEED * draw[6:9],
            horizontal_accuracy=accuracy_m,
            vertical_accuracy=0.8,
            speed_accuracy=0.3,
        )
        if not jammed:
            self._jammer = None
            return clean
        if self._jammer is None:
            self._jammer = Jammer(self._rng, clean)
        return self._jammer.distort(clean)
