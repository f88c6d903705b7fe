"""Control cascades: position -> velocity -> acceleration -> attitude -> rate -> motors.

The outer loops run at 100 Hz in Python, the attitude and rate loops at 400 Hz as a kernel.
Gains are the usual ones of a well-tuned 2.5 kg quadrotor; limits come from ArduPilot's parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2, copysign, cos, hypot, radians, sin, sqrt

import numpy as np
from numba import njit

from sitl.embedded.ekf.navigation import BG, strapdown
from sitl.embedded.physics.dynamics import (
    ARM,
    GRAVITY,
    INERTIA_XY,
    INERTIA_Z,
    MASS,
    MOTOR_MAX,
    RATES,
    SUBSTEP_S,
    SUBSTEPS,
    TICK_S,
    YAW_PER_THRUST,
    step,
)
from sitl.embedded.physics.rotation import Array, matrix, quaternion, rotate_body, wrap_pi


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


Vector = tuple[float, float, float]

_MAX_LEAN = radians(30.0)  # ArduPilot's ANGLE_MAX
_MAX_YAW_RATE = radians(60.0)
_MAX_ACCELERATION = 5.0  # m/s², horizontal; what the greatest lean gives
_JERK = 15.0  # m/s³, horizontal
_POSITION_P, _VELOCITY_P, _VELOCITY_I = 1.0, 2.0, 0.5
_HEIGHT_P, _CLIMB_P, _CLIMB_I = 1.0, 4.0, 1.0


@njit(cache=True)
def attitude_control(
    q: Array, gyro: Array, target: Array, integrator: Array, dt: float, motors: Array
) -> None:
    """Attitude and rate loops: write the four motor thrusts (N) to `motors`. q: attitude, body to
    NED; gyro: rad/s, body axes; target: (5,) attitude quaternion and total thrust in N; integrator:
    (3,) of the rate loop, updated in place; dt: seconds.
    """
    # Error quaternion conj(q) * target; its vector part is half the rotation vector.
    w, x, y, z = q[0], -q[1], -q[2], -q[3]
    a, b, c, d = target[0], target[1], target[2], target[3]
    ew = w * a - x * b - y * c - z * d
    sign = 2.0 if ew >= 0 else -2.0
    error = (
        sign * (w * b + x * a + y * d - z * c),
        sign * (w * c - x * d + y * a + z * b),
        sign * (w * d + x * c - y * b + z * a),
    )
    torque = [0.0, 0.0, 0.0]
    for i in range(3):
        tilt = i < 2
        limit = 3.5 if tilt else 1.2
        rate = min(max((6.0 if tilt else 2.5) * error[i], -limit), limit) - gyro[i]
        integrator[i] = min(max(integrator[i] + (8.0 if tilt else 2.0) * rate * dt, -8.0), 8.0)
        inertia = INERTIA_XY if tilt else INERTIA_Z
        torque[i] = inertia * ((16.0 if tilt else 6.0) * rate + integrator[i])
    base = target[4] / 4.0
    r, p, h = torque[0] / (4 * ARM), torque[1] / (4 * ARM), torque[2] / (4 * YAW_PER_THRUST)
    h = min(max(h, -0.25 * MOTOR_MAX), 0.25 * MOTOR_MAX)  # yaw is the first to give way
    motors[0] = base - r + p + h
    motors[1] = base + r - p + h
    motors[2] = base + r + p - h
    motors[3] = base - r - p - h


def sqrt_controller(error: float, gain: float, limit: float) -> float:
    """Target speed for a position error: gain * error near zero; farther away, the speed from which
    `limit` (m/s²) can still stop.
    """
    linear = limit / gain**2
    if abs(error) <= linear:
        return gain * error
    return copysign(sqrt(2.0 * limit * (abs(error) - linear / 2.0)), error)


@dataclass(frozen=True)
class ControlLimits:
    """Speeds in m/s, accelerations in m/s² (WPNAV_*)."""

    speed: float
    climb: float
    descent: float
    acceleration: float
    vertical_acceleration: float


@dataclass
class SetPoint:
    """A set point that moves along a straight leg with limited speed and acceleration."""

    start: Vector
    end: Vector
    speed: float = 0.0  # along the leg, m/s
    position: Vector = field(init=False)
    velocity: Vector = field(init=False, default=(0.0, 0.0, 0.0))
    acceleration: Vector = field(init=False, default=(0.0, 0.0, 0.0))
    _travelled: float = field(init=False, default=0.0)

    def __post_init__(self) -> None:
        self.position = self.start

    @property
    def arrived(self) -> bool:
        """Whether the set point is at the leg's end."""
        return self.position == self.end

    def move(self, vehicle: Vector, limits: ControlLimits, dt: float) -> None:
        """Advance the set point by dt seconds (above 0). vehicle: the vehicle's estimated position,
        NED m from the EKF's origin.

        The set point slows down if the vehicle lags by more than half of 2 m + 1.5 s at full speed,
        and stops at the whole of that distance.
        """
        leg = tuple(e - s for s, e in zip(self.start, self.end, strict=True))
        length = sqrt(sum(c * c for c in leg))
        if length < 1e-3 or self._travelled >= length:
            self.position = self.end
            self.velocity = self.acceleration = (0.0, 0.0, 0.0)
            return
        direction = tuple(c / length for c in leg)
        cap, acceleration = _along(direction, limits)
        lag = sqrt(sum((a - b) ** 2 for a, b in zip(self.position, vehicle, strict=True)))
        leash = 2.0 + 1.5 * cap
        wanted = min(cap, sqrt(2.0 * acceleration * (length - self._travelled)) + 0.05)
        wanted *= min(1.0, max(0.0, 2.0 * (1.0 - lag / leash)))
        step = acceleration * dt
        change = min(max(wanted - self.speed, -2.0 * step), step)
        self.speed += change
        self._travelled = min(length, self._travelled + self.speed * dt)
        n, e, d = direction
        self.position = (
            self.start[0] + n * self._travelled,
            self.start[1] + e * self._travelled,
            self.start[2] + d * self._travelled,
        )
        self.velocity = (n * self.speed, e * self.speed, d * self.speed)
        rate = change / dt
        self.acceleration = (n * rate, e * rate, d * rate)


def _along(direction: tuple[float, ...], limits: ControlLimits) -> tuple[float, float]:
    """Greatest speed and acceleration along a unit NED direction."""
    horizontal, down = hypot(direction[0], direction[1]), direction[2]
    speed, acceleration = 1e3, 1e3
    if horizontal > 1e-3:
        speed = min(speed, limits.speed / horizontal)
        acceleration = min(acceleration, limits.acceleration / horizontal)
    if abs(down) > 1e-3:
        speed = min(speed, (limits.descent if down > 0 else limits.climb) / abs(down))
        acceleration = min(acceleration, limits.vertical_acceleration / abs(down))
    return speed, acceleration


class PositionController:
    """Computes attitude and thrust from velocity targets; has integrators."""

    def __init__(self) -> None:
        self._integral = [0.0, 0.0, 0.0]  # m/s², NED
        self._acceleration = [0.0, 0.0]  # jerk-limited horizontal command, m/s²
        self.yaw_rad = 0.0

    def reset(self, yaw_rad: float) -> None:
        """Clear the integrators and hold a heading."""
        self._integral = [0.0, 0.0, 0.0]
        self._acceleration = [0.0, 0.0]
        self.yaw_rad = yaw_rad

    def turn(self, yaw_rad: float, dt: float) -> None:
        """Move the heading target towards `yaw_rad`, at the slew limit."""
        error = wrap_pi(yaw_rad - self.yaw_rad)
        limit = _MAX_YAW_RATE * dt
        self.yaw_rad = wrap_pi(self.yaw_rad + min(max(error, -limit), limit))

    def velocity_for(self, error: Vector, feedforward: Vector, limits: ControlLimits) -> Vector:
        """Velocity target (NED m/s) for a position error (NED m); feedforward: the set point's."""
        distance = hypot(error[0], error[1])
        pull = sqrt_controller(distance, _POSITION_P, limits.acceleration)
        scale = pull / distance if distance > 1e-6 else 0.0
        north, east = feedforward[0] + scale * error[0], feedforward[1] + scale * error[1]
        speed = hypot(north, east)
        if speed > 1.2 * limits.speed:
            north, east = (v * 1.2 * limits.speed / speed for v in (north, east))
        down = feedforward[2] + sqrt_controller(error[2], _HEIGHT_P, limits.vertical_acceleration)
        return north, east, min(max(down, -1.2 * limits.climb), 1.2 * limits.descent)

    def horizontal(
        self, wanted: Vector, velocity: Vector, feedforward: Vector, dt: float
    ) -> tuple[float, float]:
        """Horizontal acceleration command (north, east m/s²). wanted: velocity target, velocity:
        the present one, both NED m/s; feedforward: the set point's own acceleration.
        """
        errors = [wanted[i] - velocity[i] for i in range(2)]
        raw = [feedforward[i] + _VELOCITY_P * errors[i] + self._integral[i] for i in range(2)]
        size = hypot(raw[0], raw[1])
        if size > _MAX_ACCELERATION:  # saturated: hold the integrators
            raw = [c * _MAX_ACCELERATION / size for c in raw]
        else:
            for i in range(2):
                integral = self._integral[i] + _VELOCITY_I * errors[i] * dt
                self._integral[i] = min(max(integral, -4.0), 4.0)
        limit = _JERK * dt
        for i in range(2):
            self._acceleration[i] += min(max(raw[i] - self._acceleration[i], -limit), limit)
        return self._acceleration[0], self._acceleration[1]

    def thrust(
        self, wanted_down: float, velocity_down: float, tilt_cosine: float, dt: float
    ) -> float:
        """Total thrust (N), limited, from wanted and present down velocity (m/s). tilt_cosine:
        cosine of the vehicle's tilt; dt: seconds. Updates the integral of the climb loop.
        """
        error = wanted_down - velocity_down
        self._integral[2] = min(max(self._integral[2] + _CLIMB_I * error * dt, -3.0), 3.0)
        down = min(max(_CLIMB_P * error + self._integral[2], -5.0), 4.0)
        total = MASS * (GRAVITY - down) / max(tilt_cosine, 0.7)
        return min(max(total, 0.05 * 4 * MOTOR_MAX), 0.9 * 4 * MOTOR_MAX)

    def lean(self, acceleration: tuple[float, float], yaw_rad: float) -> Array:
        """Attitude quaternion that tilts the thrust so that it gives a horizontal acceleration
        (north, east m/s²). yaw_rad: the present heading; the quaternion's heading is the
        controller's target.
        """
        n, e = acceleration
        forward = n * cos(yaw_rad) + e * sin(yaw_rad)
        right = -n * sin(yaw_rad) + e * cos(yaw_rad)
        tilt = atan2(hypot(forward, right), GRAVITY)
        scale = min(1.0, _MAX_LEAN / tilt) if tilt > 1e-9 else 1.0
        pitch = atan2(-forward, GRAVITY) * scale
        roll = atan2(right * cos(pitch), GRAVITY) * scale
        return quaternion(roll, pitch, self.yaw_rad)
