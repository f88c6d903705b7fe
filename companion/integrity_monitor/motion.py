"""Compares vision's displacement with the IMU's over 1, 3 and 10 s.

The EKF cannot be the reference: on vision alone it follows what it is fed. A small filter predicts
each fix from earlier fixes and the IMU. A frozen or foreign image of a moving aircraft is metres
off that prediction within a second. In a hover the IMU shows little: its tilt may be wrong by a
tenth of a metre per second squared. There the images must show a fault. A position that does not
move is no fault, but it does not prove that a fault is over.

Scale check: odometry scales with the assumed height above ground. A wrong height scales velocity
and acceleration by the same factor. The IMU measures acceleration in turns and stops; straight
flight at constant speed gives no information.
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


Array = NDArray[np.float64]
_SIGMA_FLOOR_M = 0.2
# Of the odometry's from fix to fix, with what its scale error does in a turn; its sigma would hide
# a frozen picture.
_BY_ODOMETRY_M = 0.5
_SIGMAS = 4.0
# The noisier the fixes, the longer the filter lives by the IMU alone, and the further an error of
# tilt that it does not model carries it: honest fixes of sigma 2 m were withheld for 4 m (SITL).
_SLOW_SHARE = 1.5
_INDEPENDENT_HZ = 2.0  # errors of vision are alike within half a second
_LIMITS_M = {1.0: 1.5, 3.0: 1.0, 10.0: 0.8}  # of the mean deviation, by the window, s
_STILL_M = 0.1  # position changes below this do not count as motion
_GAP_S = 3.0  # without fixes, after which the prediction restarts
_SETTLE_S = 5.0  # until velocity and bias are known
_BLOCK_S = 1.0
_LEAST_FIXES = 3  # of a window
CALM_SHARE = 0.5  # of a motion limit, below which vision agrees with the IMU
_MOVES_S = 5.0  # a position that stood still for less moves


@dataclass(frozen=True)
class MotionVerdict:
    """Result of the motion check. settled: False for the first 5 s, without evidence. share: the
    largest mean deviation from the IMU divided by its limit; deviation_m: that deviation. still_s:
    how long the position has not moved.
    """

    settled: bool
    share: float
    deviation_m: float
    still_s: float

    @property
    def agrees(self) -> bool:
        """Whether vision moves, and as the IMU does."""
        return self.share < CALM_SHARE and self.still_s < _MOVES_S


class MotionCheck:
    """Compares fixes with their prediction by the IMU (`track`); in time order, one thread."""

    def __init__(self, track: InertialTrack) -> None:
        self._track = track
        self._place = LocalPlace()
        self._moved: InertialDisplacement | None = None
        self._x = np.zeros((3, 2))  # position, velocity, bias; north and east
        self._P = np.zeros((3, 3))
        self._began_ns = 0
        self._restarts = 0
        self._deviations: deque[tuple[int, float, float, float, float]] = deque(maxlen=1024)
        self._still = StillPosition(_STILL_M)

    def add(self, fix: VisionFix, *, jumped: bool) -> MotionVerdict:
        """Add a fix that the IMU's record reaches (`ready`). jumped: restart the prediction at this
        fix.
        """
        here = np.array(self._place.ned(fix)[:2])
        still_s = self._still.add(fix.time_ns, here)
        moved = self._track.at(fix.time_ns)
        if moved is None:
            self._moved = None
            return MotionVerdict(False, 0.0, 0.0, still_s)
        most_m = _BY_ODOMETRY_M if fix.by_odometry else np.inf
        sigma = float(np.clip(fix.horizontal_sigma_m, _SIGMA_FLOOR_M, most_m))
        last = self._moved
        gap_s = np.inf if last is None else (fix.time_ns - last.time_ns) * 1e-9
        anew = self._restarts != self._track.restarts or gap_s > _GAP_S or jumped
        self._moved, self._restarts = moved, self._track.restarts
        if last is None or anew or gap_s <= 0.0:
            self._start(fix.time_ns, here, sigma)
        else:
            self._step(last, moved, here, sigma)
        settled = (fix.time_ns - self._began_ns) * 1e-9 >= _SETTLE_S
        share, deviation_m = self._largest_deviation(fix.time_ns) if settled else (0.0, 0.0)
        return MotionVerdict(settled, share, deviation_m, still_s)

    def ready(self, fix: VisionFix) -> bool:
        """Whether the IMU's record reaches the time of the fix."""
        return self._track.newest_ns >= fix.time_ns

    def _start(self, time_ns: int, here: Array, sigma: float) -> None:
        self._x = np.zeros((3, 2))
        self._x[0] = here
        self._P = np.diag([sigma**2, 25.0, 0.3**2])
        self._began_ns = time_ns
        self._deviations.clear()

    def _step(
        self, last: InertialDisplacement, moved: InertialDisplacement, here: Array, sigma: float
    ) -> None:
        """Predict by the IMU, store the deviation, update with the fix. Per axis: p, v, bias."""
        h = (moved.time_ns - last.time_ns) * 1e-9
        F = np.array([[1.0, h, -0.5 * h * h], [0.0, 1.0, -h], [0.0, 0.0, 1.0]])
        q, b = SENSORS.imu_noise**2, SENSORS.imu_bias_walk**2
        Q = np.array(
            [[h**3 / 3 * q, h * h / 2 * q, 0.0], [h * h / 2 * q, h * q, 0.0], [0, 0, b * h]]
        )
        self._x = F @ self._x
        self._x[0] += moved.position - last.position - last.velocity * h
        self._x[1] += moved.velocity - last.velocity
        self._P = F @ self._P @ F.T + Q
        S = self._P[0, 0] + sigma**2
        deviation = here - self._x[0]
        north, east = float(deviation[0]), float(deviation[1])
        self._deviations.append((moved.time_ns, north, east, float(self._P[0, 0]), sigma**2))
        K = self._P[:, 0] / S
        self._x = self._x + np.outer(K, deviation)
        self._P = self._P - np.outer(K, self._P[0])

    def _largest_deviation(self, now_ns: int) -> tuple[float, float]:
        rows = np.array(self._deviations)
        worst = (0.0, 0.0)
        for window_s, limit_m in _LIMITS_M.items():
            inside = rows[rows[:, 0] > now_ns - window_s * 1e9]
            if len(inside) < _LEAST_FIXES:
                continue
            mean = float(np.hypot(*inside[:, 1:3].mean(axis=0)))
            independent = min(len(inside), max(1.0, _INDEPENDENT_HZ * window_s))
            # What the prediction is off is the same all along; only the fixes' errors average.
            predicted, seen = inside[:, 3].mean(), inside[:, 4].mean() / independent
            limit = limit_m + _SIGMAS * float(np.sqrt(predicted + seen))
            limit += _SLOW_SHARE * float(np.sqrt(inside[:, 4].mean()))
            worst = max(worst, (float(mean / limit), mean))
        return worst


class StillPosition:
    """Measures how long the position, averaged over seconds, has stayed within a distance."""

    def __init__(self, within_m: float) -> None:
        self._within_m = within_m
        self._block: list[Array] = []
        self._block_ns = 0
        self._reference: tuple[int, Array] | None = None

    def add(self, time_ns: int, here: Array) -> float:
        """Add a position (2,), m east and north of a fixed point, of the time time_ns. Returns for
        how many seconds the position has not moved; 0 during the first block of positions.
        """
        if not self._block:
            self._block_ns = time_ns
        self._block.append(here)
        if time_ns - self._block_ns >= _BLOCK_S * 1e9:
            mean = np.mean(self._block, axis=0)
            gap = time_ns - self._block_ns > 3.0 * _BLOCK_S * 1e9
            reference = self._reference
            if gap or reference is None or np.hypot(*(mean - reference[1])) > self._within_m:
                self._reference = (self._block_ns, mean)
            self._block = []
        return 0.0 if self._reference is None else (time_ns - self._reference[0]) * 1e-9
