"""Integrates the IMU alone, independent of any estimator.

The autopilot's attitude follows what is injected: an EKF that is fed a frozen position explains the
acceleration away as tilt. Here the gyros carry the attitude, which is pulled towards the
autopilot's over 20 s only. The user of the integral must estimate the remaining tilt error as a
bias.
"""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavlink_bridge import quaternion as quat
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.messages import Attitude, InertialSample

Array = NDArray[np.float64]
_LEAN_S = 20.0  # towards the autopilot's attitude
_BIAS_S = 60.0  # of the gyros' bias
_GAP_S = 0.3  # longer without samples the motion is unknown
_KEPT = 1024


@dataclass(frozen=True)
class InertialDisplacement:
    """The IMU's integral at a time: velocity and position (2,), north and east, m/s, m.

    Both start at zero at an arbitrary time and drift, so only their changes over seconds are
    meaningful.
    """

    time_ns: int
    velocity: Array
    position: Array


class InertialTrack:
    """Integrates samples as they arrive; `follow` and `at` on any thread. restarts: number of
    times that the integral began again at zero, the first included.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.restarts = 0
        self.newest_ns = 0
        self._q: quat.Quaternion | None = None
        self._bias = np.zeros(3)
        self._last: tuple[int, Array] | None = None
        self._track: deque[InertialDisplacement] = deque(maxlen=_KEPT)

    def follow(self, vehicle: Bridge) -> None:
        """Integrate the vehicle's samples since the newest one integrated."""
        with self._lock:
            for sample in vehicle.inertial_since(self.newest_ns):
                self.add(sample, vehicle.attitude_at)

    def add(self, sample: InertialSample, attitude_at: Callable[[int], Attitude | None]) -> None:
        """Integrate one sample of specific force and turn rates; to be called by one thread only.
        attitude_at: the autopilot's attitude at a time (ns). A sample is ignored if it is not newer
        than the last, or if the attitude is unknown at its time. After 0.3 s without samples the
        integral restarts.
        """
        reference = attitude_at(sample.time_ns)
        if reference is None or sample.time_ns <= self.newest_ns:
            return
        dt = (sample.time_ns - self.newest_ns) * 1e-9
        self.newest_ns = sample.time_ns
        if self._q is None or dt > _GAP_S:
            self._q, self._last = reference.quaternion, None
            self._track.clear()
            self.restarts += 1
            dt = 0.0
        q = self._turned(self._q, sample, reference, dt)
        self._q = q
        north, east, _ = quat.rotate(q, sample.specific_force)
        self._integrate(sample.time_ns, np.array([north, east]), dt)

    def at(self, time_ns: int) -> InertialDisplacement | None:
        """The integral at a time, linear between samples; None outside of the newest 1024."""
        with self._lock:
            track = self._track
            if not track or not track[0].time_ns <= time_ns <= track[-1].time_ns:
                return None
            after = bisect_left(track, time_ns, key=lambda m: m.time_ns)
            a, b = track[max(after - 1, 0)], track[after]
        span = b.time_ns - a.time_ns
        t = (time_ns - a.time_ns) / span if span else 1.0
        velocity = a.velocity + t * (b.velocity - a.velocity)
        return InertialDisplacement(time_ns, velocity, a.position + t * (b.position - a.position))

    def _turned(
        self, q: quat.Quaternion, sample: InertialSample, reference: Attitude, dt: float
    ) -> quat.Quaternion:
        w, *error = quat.multiply(quat.conjugate(q), reference.quaternion)
        lean = 2.0 * np.array(error) * (1.0 if w >= 0.0 else -1.0)
        self._bias -= lean * dt / (_LEAN_S * _BIAS_S)
        rates = np.array(sample.rates) - self._bias + lean / _LEAN_S
        return quat.rotated(q, (float(rates[0]), float(rates[1]), float(rates[2])), dt)

    def _integrate(self, time_ns: int, acceleration: Array, dt: float) -> None:
        if self._last is None or not self._track:
            self._track.append(InertialDisplacement(time_ns, np.zeros(2), np.zeros(2)))
        else:
            before = self._track[-1]
            velocity = before.velocity + 0.5 * (self._last[1] + acceleration) * dt
            position = before.position + 0.5 * (before.velocity + velocity) * dt
            self._track.append(InertialDisplacement(time_ns, velocity, position))
        self._last = (time_ns, acceleration)
