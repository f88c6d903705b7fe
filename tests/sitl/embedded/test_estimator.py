"""Navigation kernels against closed forms, and the filter's rules one by one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sitl.embedded.control.controller import ControlLimits, SetPoint, attitude_control
from sitl.embedded.ekf import navigation as nav
from sitl.embedded.ekf.aided_filter import Aiding
from sitl.embedded.ekf.estimator import Estimator
from sitl.embedded.ekf.injection import ExternalNavInput
from sitl.embedded.ekf.measurements import Baro, ExternalPosition, ExternalVelocity, GpsData
from sitl.embedded.mavlink.server import JitterCorrection
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics import dynamics
from sitl.embedded.physics.dynamics import GRAVITY, MASS
from sitl.embedded.physics.rotation import euler, quaternion, rotate_world
from sitl.geodesy import Location

ORIGIN = Location(47.397742, 8.545594, 488.0)
AT_REST = np.array([0, 0, 0, 0, 0, -GRAVITY * 0.01, 0.01])


def nominal(roll=0.0, pitch=0.0, yaw=0.0):
    s = np.zeros(nav.NOMINAL_SIZE)
    s[nav.Q : nav.Q + 4] = quaternion(roll, pitch, yaw)
    return s


def test_strapdown_stays_at_rest_and_falls_as_it_should():
    s = nominal(0.0, 0.0, 1.0)
    for _ in range(1000):
        nav.strapdown(s, AT_REST)
    assert np.allclose(s[nav.V : nav.P + 3], 0.0, atol=1e-9)
    for _ in range(100):
        nav.strapdown(s, np.array([0, 0, 0, 0, 0, 0, 0.01]))
    assert s[nav.V + 2] == pytest.approx(GRAVITY)
    assert s[nav.P + 2] == pytest.approx(GRAVITY / 2)


def perturbed(s, error):
    out = s.copy()
    rotate_world(out[nav.Q : nav.Q + 4], *error[0:3])
    out[nav.V :] += error[3:]
    return out


def difference(a, b):
    """Error state that takes b to a, to first order."""
    ra, rb = quaternion_to_matrix(a[0:4]), quaternion_to_matrix(b[0:4])
    turn = ra @ rb.T
    rotation = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    return np.concatenate([rotation, a[nav.V :] - b[nav.V :]])


def quaternion_to_matrix(q):
    from sitl.embedded.physics.rotation import matrix

    return matrix(q)


def test_covariance_propagates_by_the_numerical_jacobian():
    rng = np.random.default_rng(0)
    s = nominal(0.2, -0.3, 1.1)
    s[nav.V :] = rng.normal(0, 0.05, nav.NOMINAL_SIZE - 4)
    imu = np.array([0.004, -0.003, 0.006, 0.02, -0.01, -0.09, 0.01])
    A = rng.normal(0, 1, (15, 15))
    cov = A @ A.T
    step = 1e-6
    base = s.copy()
    nav.strapdown(base, imu)
    F = np.empty((15, 15))
    for i in range(15):
        moved = perturbed(s, step * np.eye(15)[i])
        nav.strapdown(moved, imu)
        F[:, i] = difference(moved, base) / step
    expected = F @ cov @ F.T
    nav.predict(s, cov, imu, np.zeros(4))
    # Second-order terms of one 10 ms step (position by half dt²) are left out of F on purpose.
    assert np.allclose(cov, expected, rtol=5e-3, atol=5e-2)
    assert np.allclose(s, base)


def test_fuse_is_the_textbook_kalman_update():
    rng = np.random.default_rng(1)
    A = rng.normal(0, 0.1, (15, 15))
    cov = A @ A.T + 0.01 * np.eye(15)
    s = nominal(yaw=0.4)
    H = np.eye(15)[6:7]
    S = float((H @ cov @ H.T).item() + 0.25)
    K = cov @ H.T / S
    expected_cov, dx = cov - K @ H @ cov, (K * 0.5).ravel()
    expected = perturbed(s, dx)
    nav.fuse(s, cov, 6, 0.5, 0.25)
    assert np.allclose(cov, expected_cov)
    assert np.allclose(s, expected, atol=1e-12)


# --- the filter's rules ------------------------------------------------------------------------

VISION = {
    "GPS1_TYPE": 0,
    "VISO_TYPE": 1,
    "VISO_DELAY_MS": 0,
    "VISO_POS_M_NSE": 0.5,
    "EK3_SRC1_POSXY": 6,
    "EK3_SRC1_VELXY": 0,
    "EK3_SRC1_VELZ": 0,
}


class Still:
    """A filter whose vehicle stands still."""

    def __init__(self, parameters=None):
        self.texts: list[Any] = []
        self.filter = Estimator(
            Parameters({**VISION, **(parameters or {})}), lambda _s, t: self.texts.append(t)
        )
        self.filter.align(0.0)
        self.filter.set_origin(ORIGIN)
        self.ms = 0

    def run(self, seconds, fix=None, every_ms=100, velocity=None, gps=None):
        for _ in range(round(seconds * 100)):
            self.ms += 10
            if fix is not None and self.ms % every_ms == 0:
                self.filter.add_external(fix, self.ms)
            if velocity is not None and self.ms % every_ms == 0:
                self.filter.add_external_velocity(velocity, self.ms)
            if gps is not None and self.ms % 200 == 0:
                self.filter.add(gps, self.ms)
            if self.ms % 100 == 0:
                self.filter.add(Baro(0.0), self.ms)
            self.filter.update(AT_REST, self.ms)


def at(north, east=0.0, sigma=0.5, yaw=None, reset=False):
    return ExternalPosition((north, east, 0.0), sigma, yaw, 0.2, reset)


def test_fixes_over_fifty_hertz_are_dropped():
    still = Still()
    still.run(1, at(0.0))
    assert still.filter.add_external(at(0.0), still.ms + 100)
    assert not still.filter.add_external(at(0.0), still.ms + 110)
    assert still.filter.add_external(at(0.0), still.ms + 120)


def test_a_smaller_claimed_sigma_pulls_harder():
    pulls = []
    for sigma in (0.5, 3.0):
        still = Still()
        still.run(5, at(0.0, sigma=sigma))
        still.run(0.05)
        still.filter.add_external(at(1.0, sigma=sigma), still.ms)
        still.run(0.3)
        pulls.append(still.filter.position[0])
    assert pulls[0] > 1.5 * pulls[1] > 0


def test_velocity_from_vision_keeps_position_for_10_s_and_then_never_takes_the_jump():
    """ardupilot.md: a jump without reset_counter while velocity is fused is never accepted."""
    still = Still({"EK3_SRC1_VELXY": 6, "EK3_SRC1_VELZ": 6})
    steady = ExternalVelocity((0.0, 0.0, 0.0), 0.1)
    still.run(5, at(0.0), velocity=steady)
    still.run(9.5, at(10.0), velocity=steady)
    assert still.filter.position_valid
    still.run(1.5, at(10.0), velocity=steady)
    assert not still.filter.position_valid


@pytest.mark.parametrize(("over_us", "velocities"), [(0, 0), (11_999, 0), (12_000, 1)])
def test_a_position_delta_over_less_than_a_step_is_no_velocity(over_us, velocities, monkeypatch):
    parameters = Parameters({"VISO_TYPE": 1})
    estimator = Estimator(parameters, lambda _severity, _text: None)
    given = []
    monkeypatch.setattr(estimator, "add_external_velocity", lambda v, _stamp: given.append(v))
    vision = ExternalNavInput(parameters, estimator)
    delta = SimpleNamespace(
        time_delta_usec=over_us, position_delta=(0.1, 0.0, 0.0), confidence=100.0
    )
    vision.position_delta(delta, 1000)
    assert len(given) == velocities
    assert vision.healthy(1000)


def test_yaw_from_vision_is_used_only_where_it_is_the_source():
    for source, expected in ((1, 0.0), (6, 0.3)):
        still = Still({"EK3_SRC1_YAW": source})
        still.run(20, at(0.0, yaw=0.3))
        assert euler(still.filter.output[0:4])[2] == pytest.approx(expected, abs=0.05)


GPS_DATA = GpsData(47.397742, 8.545594, 488.0, (0.0, 0.0), 0.0, 0.5, 0.3, 10, 1.0)
ON_GPS = {"GPS1_TYPE": 1, "EK3_SRC1_POSXY": 3, "EK3_SRC1_VELXY": 3, "EK3_SRC1_VELZ": 3}


def test_a_gps_of_few_satellites_or_unknown_hdop_is_never_used():
    from dataclasses import replace

    for poor in (replace(GPS_DATA, satellites=5), replace(GPS_DATA, hdop=99.99)):
        still = Still(ON_GPS)
        still.run(20, gps=poor)
        assert still.filter.sources.aiding is Aiding.NONE


def test_external_position_command_only_resets_an_unaided_filter():
    still = Still()
    still.run(3, at(0.0))
    assert not still.filter.sources.force_position(50.0, 0.0, 10.0)
    still.run(2)
    assert still.filter.sources.force_position(50.0, 0.0, 10.0)
    still.run(0.02)
    assert still.filter.position[0] == pytest.approx(50.0, abs=0.5)


def test_jitter_correction_removes_jitter_and_keeps_the_least_lag():
    correction = JitterCorrection()
    rng = np.random.default_rng(0)
    epoch = 1_700_000_000_000_000
    late = []
    for k in range(300):
        taken = k * 100_000
        received = taken + 80_000 + int(rng.uniform(0, 60_000))
        late.append(correction.correct(epoch + taken, received) - taken)
    # After the first window every stamp is the same 80 ms late, to a few ms.
    assert max(late[100:]) - min(late[100:]) < 5_000
    assert np.mean(late[100:]) == pytest.approx(80_000, abs=5_000)


# --- Physics and kernels against closed forms ---------------------------------------------------


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
