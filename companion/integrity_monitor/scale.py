"""Estimates the scale error of odometry from the IMU's acceleration.

Odometry scales with the assumed height above ground. A wrong height scales velocity and
acceleration by the same factor. The IMU measures acceleration in turns and stops; straight flight
at constant speed gives no information.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.inertial import InertialDisplacement, InertialTrack
from companion.integrity_monitor.position_checks import LocalPlace
from localizer.sensors.error_model import SENSORS
from mavlink_bridge.messages import VisionFix

_SPAN_S = 2.0  # between three places: of which the second difference is free of any velocity
_LATE_S = 0.15  # of a fix from the time that is wanted
_KEPT_S = 30.0  # the ground goes on
_LEAST_M = 2.0  # second difference of the IMU's way: 0.5 m/s^2
_NOISE_M = 0.3  # of the odometry's second difference, at least; its fit may show more
_LEVEL_MPS2 = 0.1  # what tilt and accelerometer are wrong by, constant over `_KEPT_S`
_SIGMAS = 4.0

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Bend:
    """Second differences (2,) of two paths, m: the odometry's and the IMU's."""

    time_ns: int
    seen: Array
    felt: Array


class ScaleCheck:
    """Compares the odometry with the IMU (`track`); fixes in time order, one thread."""

    def __init__(self, track: InertialTrack) -> None:
        self._track = track
        self._place = LocalPlace()
        self._ways: deque[tuple[int, Array, InertialDisplacement]] = deque()
        self._bends: deque[_Bend] = deque()
        self._restarts = 0

    def add(self, fix: VisionFix, *, jumped: bool) -> None:
        """Add a fix; one without odometry, IMU record or after a jump restarts the comparison."""
        moved = self._track.at(fix.time_ns)
        if jumped or moved is None or not fix.by_odometry or self._restarts != self._track.restarts:
            self._restarts = self._track.restarts
            self._ways.clear()
            self._bends.clear()
        if moved is None or not fix.by_odometry:
            return
        self._ways.append((fix.time_ns, np.array(self._place.ned(fix)[:2]), moved))
        while self._ways[0][0] < fix.time_ns - (2.0 * _SPAN_S + _LATE_S) * 1e9:
            self._ways.popleft()
        while self._bends and self._bends[0].time_ns < fix.time_ns - _KEPT_S * 1e9:
            self._bends.popleft()
        # Overlapping ones err alike.
        if not self._bends or fix.time_ns - self._bends[-1].time_ns >= _SPAN_S * 1e9:
            self._bend(fix.time_ns)

    def _bend(self, now_ns: int) -> None:
        three = [self._at(now_ns - round(k * _SPAN_S * 1e9)) for k in (2, 1, 0)]
        a, b, c = three
        if a is None or b is None or c is None:
            return
        # Between fixes that do not come evenly, a second difference at their own times.
        share = (b[0] - a[0]) / (c[0] - a[0])
        weights = np.array([1.0 - share, -1.0, share]) * 2.0
        seen = weights @ np.array([one[1] for one in three if one])
        felt = weights @ np.array([one[2].position for one in three if one])
        if np.linalg.norm(felt) >= _LEAST_M:
            self._bends.append(_Bend(now_ns, seen, felt))

    def _at(self, time_ns: int) -> tuple[int, Array, InertialDisplacement] | None:
        nearest = min(self._ways, key=lambda one: abs(one[0] - time_ns))
        return nearest if abs(nearest[0] - time_ns) <= _LATE_S * 1e9 else None

    @property
    def scale_error(self) -> float:
        """Size of odometry's relative scale error (0.1: 10 %) if above 4 sigma, otherwise 0.0."""
        if not self._bends:
            return 0.0
        felt = np.concatenate([one.felt for one in self._bends])
        seen = np.concatenate([one.seen for one in self._bends])
        size = float(felt @ felt)
        factor = float(felt @ seen) / size
        # A level error is one and the same in all of them, as the noise is not.
        level = np.sum([one.felt for one in self._bends], axis=0) * _LEVEL_MPS2 * _SPAN_S**2
        left = seen - factor * felt
        noise = max(_NOISE_M**2, float(left @ left) / (len(left) - 1))
        noise += SENSORS.imu_noise**2 * _SPAN_S**3
        sigma = float(np.sqrt(level @ level + size * noise)) / size
        if abs(factor - 1.0) <= _SIGMAS * sigma:
            return 0.0
        return abs(1.0 - 1.0 / factor) if factor > 0.0 else 1.0
