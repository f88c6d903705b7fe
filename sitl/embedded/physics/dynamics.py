"""Rigid-body dynamics of a 2.5 kg quadrotor in X configuration (ArduPilot's motor order).

Motors are first-order thrust sources, drag is linear plus quadratic in the relative wind, and the
ground is the plane through home. Semi-implicit Euler at 400 Hz: at the 25 rad/s of motors and rate
loop its error is far below that of the sensors.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit

from sitl.embedded.physics.rotation import Array, matrix, rotate_body

SUBSTEPS = 4  # of the integration, in a tick of the vehicle
SUBSTEP_S = 0.0025
TICK_S = SUBSTEPS * SUBSTEP_S
GRAVITY = 9.80665
MASS = 2.5  # kg
INERTIA_XY = 0.035  # kg m²
INERTIA_Z = 0.06
ARM = 0.25 * sqrt(0.5)  # m, along each body axis
YAW_PER_THRUST = 0.02  # N m of reaction torque per N of thrust
MOTOR_MAX = 16.0  # N; hover is then at 0.38 throttle, as in ArduPilot's default quad
MOTOR_TIME_CONSTANT = 0.04  # s
DRAG_LINEAR = 0.10  # 1/s, per kg
DRAG_QUADRATIC = 0.015  # 1/m, per kg

# Layout of the true state x: position NED, velocity NED, attitude, body rates, motor thrusts.
POSITION, VELOCITY, ATTITUDE, RATES, THRUST, STATE_SIZE = 0, 3, 6, 10, 13, 17


def initial_state(yaw_rad: float) -> Array:
    """State (17,) at rest on the ground at home, level, with heading `yaw_rad`."""
    x = np.zeros(STATE_SIZE)
    x[ATTITUDE] = np.cos(yaw_rad / 2)
    x[ATTITUDE + 3] = np.sin(yaw_rad / 2)
    return x


@njit(cache=True)
def step(x: Array, motors: Array, wind: Array, dt: float, force: Array) -> None:
    """Advance the true state x (17,) by dt seconds, in place.

    motors: (4,) commanded thrusts in N; wind: (3,) NED m/s; force: (3,) is set to the specific
    force in body axes (m/s²), which accelerometers measure.
    """
    for i in range(4):
        lag = dt / (MOTOR_TIME_CONSTANT + dt)
        x[THRUST + i] += lag * (min(max(motors[i], 0.0), MOTOR_MAX) - x[THRUST + i])
    t1, t2, t3, t4 = x[THRUST], x[THRUST + 1], x[THRUST + 2], x[THRUST + 3]
    R = matrix(x[ATTITUDE : ATTITUDE + 4])

    relative = x[VELOCITY : VELOCITY + 3] - wind
    speed = sqrt(relative[0] ** 2 + relative[1] ** 2 + relative[2] ** 2)
    felt = -(DRAG_LINEAR + DRAG_QUADRATIC * speed) * relative - R[:, 2] * (
        (t1 + t2 + t3 + t4) / MASS
    )
    acceleration_down = felt[2] + GRAVITY

    if x[POSITION + 2] >= 0.0 and acceleration_down >= 0.0 and x[VELOCITY + 2] >= 0.0:
        _rest(x)
        force[0], force[1], force[2] = 0.0, 0.0, -GRAVITY
        return

    for i in range(3):
        x[VELOCITY + i] += dt * (felt[i] + (GRAVITY if i == 2 else 0.0))
        x[POSITION + i] += dt * x[VELOCITY + i]
    p, q, r = x[RATES], x[RATES + 1], x[RATES + 2]
    x[RATES] += (
        dt * (ARM * (-t1 + t2 + t3 - t4) - (INERTIA_Z - INERTIA_XY) * q * r - 0.02 * p) / INERTIA_XY
    )
    x[RATES + 1] += (
        dt * (ARM * (t1 - t2 + t3 - t4) - (INERTIA_XY - INERTIA_Z) * p * r - 0.02 * q) / INERTIA_XY
    )
    x[RATES + 2] += dt * (YAW_PER_THRUST * (t1 + t2 - t3 - t4) - 0.02 * r) / INERTIA_Z
    attitude = x[ATTITUDE : ATTITUDE + 4]
    rotate_body(attitude, x[RATES] * dt, x[RATES + 1] * dt, x[RATES + 2] * dt)
    for i in range(3):
        force[i] = R[0, i] * felt[0] + R[1, i] * felt[1] + R[2, i] * felt[2]


@njit(cache=True)
def _rest(x: Array) -> None:
    """On the ground: at rest and level, heading kept."""
    yaw_norm = sqrt(x[ATTITUDE] ** 2 + x[ATTITUDE + 3] ** 2)
    x[ATTITUDE] /= yaw_norm
    x[ATTITUDE + 3] /= yaw_norm
    x[ATTITUDE + 1] = x[ATTITUDE + 2] = 0.0
    x[POSITION + 2] = 0.0
    for i in range(3):
        x[VELOCITY + i] = 0.0
        x[RATES + i] = 0.0
