import math

import numpy as np
import pytest

from companion.conversions import CameraExtrinsics, vehicle_prior, vision_fix
from companion.geometry import ned_from_world
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import matrix_from_euler, quaternion_from_matrix
from mavlink_bridge.messages import Attitude, GimbalAttitude, VehicleState
from tests.companion.estimates import estimated

ORIGIN = Geodetic(47.3, 8.5, 450.0)
FRAME = LocalFrame(ORIGIN)
LEVER = np.array([0.4, -0.1, 0.2])
SEPARATION = 47.5
INSTALLATION = CameraExtrinsics(FRAME, SEPARATION, LEVER)


def _attitude(roll, pitch, yaw, time_ns=0) -> Attitude:
    q = quaternion_from_matrix(matrix_from_euler(roll, pitch, yaw))
    return Attitude(time_ns, roll, pitch, yaw, tuple(float(x) for x in q))


def _gimbal(pitch, yaw, time_ns=0) -> GimbalAttitude:
    q = quaternion_from_matrix(matrix_from_euler(0.0, pitch, yaw))
    return GimbalAttitude(time_ns, 0.0, pitch, yaw, tuple(float(x) for x in q), "test")


def _state(position: Geodetic, time_ns: int = 0, velocity=None) -> VehicleState:
    return VehicleState(
        connected=True,
        latitude_deg=position.latitude_deg,
        longitude_deg=position.longitude_deg,
        altitude_amsl_m=position.height_m - SEPARATION,
        position_time_ns=time_ns,
        local_velocity_ned=velocity,
    )


def _prior(state, attitude, gimbal, time_ns=0):
    return vehicle_prior(state, attitude, gimbal, INSTALLATION, (5.0, 0.1), time_ns)


@pytest.mark.parametrize("seed", range(5))
def test_fix_of_the_prior_is_the_vehicle_again(seed):
    rng = np.random.default_rng(seed)
    attitude = _attitude(*rng.uniform(-0.4, 0.4, 2), rng.uniform(-3, 3))
    gimbal = _gimbal(rng.uniform(-1.5, -0.2), rng.uniform(-3, 3))
    vehicle = FRAME.position(rng.uniform(-2000, 2000, 3))
    prior = _prior(_state(vehicle), attitude, gimbal)
    estimate = estimated(prior.world_from_camera, covariance=prior.covariance, quality=0.9)
    fix = vision_fix(estimate, INSTALLATION, attitude, gimbal, 0)
    seen = FRAME.enu_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height_m)
    true = FRAME.enu_from_geodetic(vehicle.latitude_deg, vehicle.longitude_deg, vehicle.height_m)
    np.testing.assert_allclose(seen, true, atol=1e-6)
    same = abs(np.dot(fix.quaternion, attitude.quaternion))
    np.testing.assert_allclose(same, 1.0, atol=1e-12)
    np.testing.assert_allclose(np.trace(fix.position_covariance_ned), 75.0)
    assert fix.quality == 90


def test_without_the_gimbal_the_attitude_is_unknown_not_guessed():
    prior = _prior(_state(ORIGIN), _attitude(0, 0, 0), _gimbal(-1.5, 0))
    estimate = estimated(prior.world_from_camera, covariance=prior.covariance, quality=0.9)
    fix = vision_fix(estimate, INSTALLATION, _attitude(0, 0, 0), None, 3)
    assert fix.quaternion is None
    assert fix.yaw_rad is None
    assert fix.reset_count == 3
    # It is the camera's place that is told for the vehicle's: off by the lever arm, no one knows
    # which way, and within its covariance.
    known = vision_fix(estimate, INSTALLATION, _attitude(0, 0, 0), _gimbal(-1.5, 0), 3)
    wider = fix.position_covariance_ned - known.position_covariance_ned
    np.testing.assert_allclose(wider, np.eye(3) * (LEVER @ LEVER), atol=1e-9)


def test_prior_follows_the_velocity_and_refuses_old_or_missing_positions():
    moving = _state(ORIGIN, velocity=(10.0, 0.0, 0.0))
    a, g = _attitude(0, 0, 0), _gimbal(-1.5, 0)
    now, later = _prior(moving, a, g, 0), _prior(moving, a, g, 500_000_000)
    moved = later.world_from_camera.translation - now.world_from_camera.translation
    np.testing.assert_allclose(moved, [0.0, 5.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(later.velocity, [0.0, 10.0, 0.0], atol=1e-6)
    assert _prior(_state(ORIGIN), a, g).velocity is None
    assert _prior(moving, a, g, 5_000_000_000) is None
    assert _prior(moving, None, g) is None
    assert _prior(VehicleState(), a, g) is None


def test_north_is_the_vehicles_own_north():
    far = FRAME.position([20_000.0, 0.0, 0.0])
    R = ned_from_world(FRAME, far)
    tilt = math.degrees(math.acos((np.trace(R @ ned_from_world(FRAME, ORIGIN).T) - 1) / 2))
    assert 0.2 < tilt < 0.4  # 20 km east: 0.18° of tilt and 0.2° of convergence
