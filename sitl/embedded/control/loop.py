"""The 400 Hz inner loop: attitude control, motors, rigid body, IMU, output navigation state."""

from __future__ import annotations

import numpy as np
from numba import njit

from sitl.embedded.control.controller import attitude_control
from sitl.embedded.ekf.navigation import BG, strapdown
from sitl.embedded.physics.dynamics import RATES, SUBSTEP_S, SUBSTEPS, TICK_S, step
from sitl.embedded.physics.rotation import Array, matrix, rotate_body


@njit(cache=True)
def advance(
    x: Array,
    output: Array,
    target: Array,
    integrator: Array,
    wind: Array,
    imu_bias: Array,
    imu_noise: Array,
    increment: Array,
    armed: bool,
) -> None:
    """Advance attitude control, motors, rigid body, IMU and navigation by 10 ms, in place.

    x: true state (17,); output: nominal state at the present (16,), see `navigation`; target: (5,)
    attitude quaternion and total thrust in N; integrator: (3,) of the rate loop; wind: (3,) NED
    m/s; imu_bias: (6,) gyro and accelerometer; imu_noise: (SUBSTEPS, 6) samples; increment: (7,)
    receives the tick's IMU increments as `navigation.strapdown` takes them.
    """
    motors = np.zeros(4)
    force = np.zeros(3)
    sample = np.zeros(7)
    sample[6] = SUBSTEP_S
    sample[0:3] = increment[0:3] / SUBSTEPS  # the last tick's mean rate, for the first substep
    increment[:] = 0.0
    increment[6] = TICK_S
    turned = np.zeros(4)
    turned[0] = 1.0
    for k in range(SUBSTEPS):
        if armed:
            gyro = sample[0:3] / SUBSTEP_S - output[BG : BG + 3]
            attitude_control(output[0:4], gyro, target, integrator, SUBSTEP_S, motors)
        else:
            motors[:] = 0.0
            integrator[:] = 0.0
        step(x, motors, wind, SUBSTEP_S, force)
        for i in range(3):
            sample[i] = (x[RATES + i] + imu_bias[i] + imu_noise[k, i]) * SUBSTEP_S
            sample[3 + i] = (force[i] + imu_bias[3 + i] + imu_noise[k, 3 + i]) * SUBSTEP_S
        strapdown(output, sample)
        # Delta velocity is summed in the axes of the tick's start (sculling), so that one
        # strapdown step over the tick equals its four substeps.
        R = matrix(turned)
        for i in range(3):
            increment[i] += sample[i]
            for j in range(3):
                increment[3 + i] += R[i, j] * sample[3 + j]
        rotate_body(turned, sample[0], sample[1], sample[2])
