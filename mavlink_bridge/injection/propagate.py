"""Propagates fixes in time with a constant-velocity Kalman filter of the fixes.

The autopilot's velocity is not used, because it may result from the injected positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from mavlink_bridge.messages import VisionFix, horizontal_sigma_m
from mavlink_bridge.vehicle.origin import north_east, offset

Array = NDArray[np.float64]

_UNKNOWN_SPEED_MPS = 15.0  # 1 sigma before two fixes were seen
_FORGET_AFTER_S = 3.0
RISK_SIGMAS = 3.7  # of a risk of 1e-3


@dataclass(frozen=True)
class PropagatedFix:
    """Position at a time; height above the ellipsoid. covariance_ned (3, 3) m², velocity_ned (3,)
    m/s.
    """

    time_ns: int
    latitude_deg: float
    longitude_deg: float
    height_m: float
    covariance_ned: Array
    velocity_ned: Array
    velocity_covariance_ned: Array

    @property
    def horizontal_sigma_m(self) -> float:
        """1 sigma along the worst horizontal direction, m."""
        return horizontal_sigma_m(self.covariance_ned)

    @property
    def vertical_sigma_m(self) -> float:
        """1 sigma of the height, m."""
        return float(np.sqrt(self.covariance_ned[2, 2]))

    @property
    def speed_sigma_mps(self) -> float:
        """1 sigma of the speed along the worst direction, m/s."""
        return float(np.sqrt(np.linalg.eigvalsh(self.velocity_covariance_ned)[-1]))


def propagated_protection(fix: VisionFix, propagated: PropagatedFix) -> tuple[float, float] | None:
    """The fix's protection levels, m, increased as its sigmas by propagation; or None."""
    if fix.protection_m is None:
        return None
    begun = (fix.horizontal_sigma_m, fix.vertical_sigma_m)
    now = (propagated.horizontal_sigma_m, propagated.vertical_sigma_m)
    horizontal, vertical = (
        level + RISK_SIGMAS * max(after - before, 0.0)
        for level, before, after in zip(fix.protection_m, begun, now, strict=True)
    )
    return horizontal, vertical


class FixPropagator:
    """Estimates velocity from fixes and propagates the newest fix to a wanted time.

    The propagation starts at the newest fix itself and not at the filter's smoothed state, because
    the EKF smooths again: smoothing twice would use the same information twice. The covariance is
    that of the fix plus the uncertainty of velocity and acceleration.
    """

    def __init__(self, acceleration_sigma_mps2: float, sigma_floor_m: float) -> None:
        self._acceleration = acceleration_sigma_mps2
        self._floor = np.eye(3) * sigma_floor_m**2
        self._filter: KalmanFilter | None = None
        self._anchor = (0.0, 0.0)
        self._fix: VisionFix | None = None

    @property
    def fix(self) -> VisionFix | None:
        """The newest fix; None before the first."""
        return self._fix

    def update(self, fix: VisionFix) -> None:
        """Add a fix that is newer than all before."""
        R = fix.position_covariance_ned + self._floor
        last, self._fix = self._fix, fix
        gap_s = np.inf if last is None else (fix.time_ns - last.time_ns) * 1e-9
        if last is None or self._filter is None or gap_s > _FORGET_AFTER_S:
            self._start(fix, R)
            return
        F, Q = self._motion(gap_s)
        self._filter.predict(F=F, Q=Q)
        z = self._ned(fix)
        if fix.reset_count != last.reset_count:
            # The estimate jumped, the aircraft did not: keep the velocity, take the position.
            self._filter.x[:3, 0] = z
            self._filter.P[:3, :] = 0.0
            self._filter.P[:, :3] = 0.0
            self._filter.P[:3, :3] = R
        else:
            self._filter.update(z, R=R)

    def at(self, time_ns: int) -> PropagatedFix | None:
        """The newest fix propagated to `time_ns`; None before the first."""
        fix, kalman = self._fix, self._filter
        if fix is None or kalman is None:
            return None
        dt = (time_ns - fix.time_ns) * 1e-9
        if fix.velocity_ned is not None:
            velocity, Pv = np.array(fix.velocity_ned), np.eye(3) * fix.velocity_sigma_mps**2
        else:
            velocity, Pv = kalman.x[3:, 0].copy(), kalman.P[3:, 3:].copy()
        north, east, down = velocity * dt
        latitude, longitude = offset(fix.latitude_deg, fix.longitude_deg, north, east)
        q = self._acceleration**2
        P = fix.position_covariance_ned + self._floor + Pv * dt**2 + np.eye(3) * q * dt**4 / 4.0
        return PropagatedFix(
            time_ns,
            latitude,
            longitude,
            fix.height_m - float(down),
            P,
            velocity,
            Pv + np.eye(3) * q * dt**2,
        )

    def _start(self, fix: VisionFix, R: Array) -> None:
        self._anchor = (fix.latitude_deg, fix.longitude_deg)
        kalman = KalmanFilter(dim_x=6, dim_z=3)
        kalman.x = np.zeros((6, 1))
        kalman.x[:3, 0] = self._ned(fix)
        kalman.P = np.diag([0.0] * 3 + [_UNKNOWN_SPEED_MPS**2] * 3)
        kalman.P[:3, :3] = R
        kalman.H = np.hstack([np.eye(3), np.zeros((3, 3))])
        self._filter = kalman

    def _ned(self, fix: VisionFix) -> Array:
        north, east = north_east(*self._anchor, fix.latitude_deg, fix.longitude_deg)
        return np.array([north, east, -fix.height_m])

    def _motion(self, dt: float) -> tuple[Array, Array]:
        """Transition and noise of constant velocity with white acceleration over dt seconds."""
        eye = np.eye(3)
        F = np.block([[eye, dt * eye], [np.zeros((3, 3)), eye]])
        G = np.vstack([0.5 * dt**2 * eye, dt * eye])
        return F, G @ G.T * self._acceleration**2
