"""Physics and kernels against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.embedded.control.controller import ControlLimits, SetPoint, attitude_control
from sitl.embedded.physics import dynamics
from sitl.embedded.physics.dynamics import GRAVITY, MASS
from sitl.embedded.physics.rotation import euler, quaternion

DT = 0.0025


def airborne(height=100.0):
    x = dynamics.initial_state(0.0)
    x[2] = -height
    return x


def fly(x, motors, seconds, wind=(0.0, 0.0, 0.0)):
    force = np.zeros(3)
    for _ in range(round(seconds / DT)):
        dynamics.step(x, np.asarray(motors, dtype=float), np.asarray(wind, dtype=float), DT, force)
    return force


def test_hover_thrust_holds_height():
    x = airborne()
    hover = MASS * GRAVITY / 4
    x[dynamics.THRUST :] = hover
    force = fly(x, [hover] * 4, 5.0)
    assert x[2] == pytest.approx(-100.0, abs=1e-6)
    assert np.allclose(force, [0, 0, -GRAVITY])


@pytest.mark.parametrize(
    ("faster", "axis", "sign"),
    [((1, 2), 0, 1), ((0, 2), 1, 1), ((0, 1), 2, 1), ((0, 3), 0, -1)],
    ids=["left motors roll right", "front motors pitch up", "ccw motors yaw right", "right: left"],
)
def test_motor_order_is_ardupilots_quad_x(faster, axis, sign):
    x = airborne()
    motors = [MASS * GRAVITY / 4] * 4
    for i in faster:
        motors[i] += 0.5
    fly(x, motors, 0.1)
    rates = x[dynamics.RATES : dynamics.RATES + 3]
    assert rates[axis] * sign > 0
    others = [abs(rates[i]) for i in range(3) if i != axis]
    assert max(others) < 0.05 * abs(rates[axis])


def test_attitude_control_reaches_a_lean():
    x = airborne()
    target = np.array([*quaternion(0.3, -0.2, 0.5), MASS * GRAVITY])
    integrator, motors, force = np.zeros(3), np.zeros(4), np.zeros(3)
    for _ in range(800):
        attitude_control(x[6:10], x[10:13], target, integrator, DT, motors)
        dynamics.step(x, motors, np.zeros(3), DT, force)
    assert euler(x[6:10]) == pytest.approx((0.3, -0.2, 0.5), abs=0.01)


def test_carrot_keeps_speed_and_acceleration_limits_and_stops_at_the_end():
    limits = ControlLimits(10.0, 2.5, 1.5, 2.5, 1.0)
    set_point = SetPoint((0.0, 0.0, 0.0), (200.0, 0.0, 0.0))
    speeds = [0.0]
    for _ in range(6000):
        set_point.move(set_point.position, limits, 0.01)
        speeds.append(set_point.velocity[0])
        if set_point.arrived:
            break
    assert set_point.position == (200.0, 0.0, 0.0)
    assert max(speeds) == pytest.approx(10.0, rel=0.01)
    assert np.diff(speeds[:-1]).max() <= 2.5 * 0.01 + 1e-9
    assert len(speeds) * 0.01 == pytest.approx(200 / 10 + 10 / 2.5, rel=0.05)
