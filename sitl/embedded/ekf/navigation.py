"""Strapdown navigation and the 15-state error covariance, as kernels.

Nominal state s (16,): attitude quaternion, velocity NED, position NED, gyro bias, accelerometer
bias. Error state (15,): rotation in NED axes, velocity, position, gyro bias, accelerometer bias.
IMU increments (7,): delta angle (rad), delta velocity (m/s), interval (s), all in body axes.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sitl.embedded.physics.dynamics import GRAVITY
from sitl.embedded.physics.rotation import Array, matrix, rotate_body, rotate_world

Q, V, P, BG, BA, NOMINAL_SIZE = 0, 4, 7, 10, 13, 16
ERROR_SIZE = 15


@njit(cache=True)
def strapdown(s: Array, imu: Array) -> None:
    """Propagate the nominal state s (16,) through one IMU increment (7,), in place."""
    dt = imu[6]
    R = matrix(s[Q : Q + 4])
    dv = imu[3:6] - s[BA : BA + 3] * dt
    for i in range(3):
        before = s[V + i]
        s[V + i] += R[i, 0] * dv[0] + R[i, 1] * dv[1] + R[i, 2] * dv[2]
        if i == 2:
            s[V + i] += GRAVITY * dt
        s[P + i] += 0.5 * (before + s[V + i]) * dt
    rotate_body(s[Q : Q + 4], imu[0] - s[BG] * dt, imu[1] - s[BG + 1] * dt, imu[2] - s[BG + 2] * dt)


@njit(cache=True)
def replay(s: Array, ring: Array, start: int, count: int, out: Array) -> None:
    """Propagate s through `count` buffered IMU increments ring (n, 7) from `start`, into out."""
    for i in range(NOMINAL_SIZE):
        out[i] = s[i]
    for k in range(count):
        strapdown(out, ring[(start + k) % ring.shape[0]])


@njit(cache=True)
def predict(s: Array, cov: Array, imu: Array, noise: Array) -> None:
    """Propagate state s (16,) and covariance cov (15, 15) through one IMU increment (7,), in place.

    noise: (4,) EK3_GYRO_P_NSE, EK3_ACC_P_NSE, EK3_GBIAS_P_NSE, EK3_ABIAS_P_NSE; as in EKF3 each
    enters as (noise * dt)² per step.
    """
    dt = imu[6]
    R = matrix(s[Q : Q + 4])
    dv = imu[3:6] - s[BA : BA + 3] * dt
    F = np.eye(ERROR_SIZE)
    g = np.zeros(3)
    for i in range(3):
        g[i] = R[i, 0] * dv[0] + R[i, 1] * dv[1] + R[i, 2] * dv[2]
        for j in range(3):
            F[i, 9 + j] = -R[i, j] * dt
            F[3 + i, 12 + j] = -R[i, j] * dt
        F[6 + i, 3 + i] = dt
    F[3, 1], F[3, 2] = g[2], -g[1]
    F[4, 0], F[4, 2] = -g[2], g[0]
    F[5, 0], F[5, 1] = g[1], -g[0]
    cov[:, :] = F @ cov @ F.T
    for i in range(3):
        cov[i, i] += (noise[0] * dt) ** 2
        cov[3 + i, 3 + i] += (noise[1] * dt) ** 2
        cov[9 + i, 9 + i] += (noise[2] * dt) ** 2
        cov[12 + i, 12 + i] += (noise[3] * dt) ** 2
    strapdown(s, imu)


@njit(cache=True)
def fuse(s: Array, cov: Array, index: int, innovation: float, variance: float) -> None:
    """Scalar Kalman update of the error state `index` that was observed directly, in place. s:
    nominal state (16,); cov: (15, 15); innovation: measured minus predicted; variance: of the
    measurement.
    """
    gain = cov[:, index] / (cov[index, index] + variance)
    row = cov[index, :].copy()
    for i in range(ERROR_SIZE):
        for j in range(ERROR_SIZE):
            cov[i, j] -= gain[i] * row[j]
    for i in range(ERROR_SIZE):
        for j in range(i):
            mean = 0.5 * (cov[i, j] + cov[j, i])
            cov[i, j] = cov[j, i] = mean
        cov[i, i] = max(cov[i, i], 1e-12)
    d = gain * innovation
    rotate_world(s[Q : Q + 4], d[0], d[1], d[2])
    for i in range(12):
        s[V + i] += d[3 + i]


def reset_error(cov: Array, start: int, count: int, variance: float) -> None:
    """Set `count` error states of cov (15, 15) from `start` on to `variance`, uncorrelated with all
    others, in place.
    """
    block = slice(start, start + count)
    cov[block, :] = 0.0
    cov[:, block] = 0.0
    cov[block, block] = np.eye(count) * variance
