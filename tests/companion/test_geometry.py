"""The chain from vehicle to camera, held to cases worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.conversions import CameraExtrinsics, vehicle_prior, vision_fix
from companion.geometry import GimbalAngles, GimbalFrame, Mount, camera_attitude, world_from_camera
from localizer.geometry.geo import NED_FROM_ENU, Geodetic, LocalFrame
from localizer.geometry.pose import matrix_from_euler, quaternion_from_matrix
from localizer.geometry.trajectory import pose_row
from mavlink_bridge.messages import Attitude, GimbalAttitude, VehicleState
from tests.companion.estimates import estimated

LEVEL = Mount.from_degrees()
NORTH, EAST, DOWN = np.eye(3)


def _attitude(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    return matrix_from_euler(*np.radians([roll, pitch, yaw]))


def _gimbal(pitch: float, yaw: float = 0.0, frame: str = "heading") -> GimbalAngles:
    return GimbalAngles(0.0, np.radians(pitch), np.radians(yaw), GimbalFrame(frame))


# Camera axes in NED as (right, down, forward).
@pytest.mark.parametrize(
    ("body", "gimbal", "axes"),
    [
        (_attitude(), _gimbal(0), (EAST, DOWN, NORTH)),
        (_attitude(yaw=90), _gimbal(0), (-NORTH, DOWN, EAST)),
        (_attitude(), _gimbal(-90), (EAST, -NORTH, DOWN)),
        (_attitude(yaw=90), _gimbal(-90), (-NORTH, -EAST, DOWN)),
        (_attitude(), _gimbal(0, 90), (-NORTH, DOWN, EAST)),
        (_attitude(yaw=90), _gimbal(0, 90), (-EAST, DOWN, -NORTH)),
        # The earth frame ignores the heading.
        (_attitude(yaw=90), _gimbal(0, 0, "earth"), (EAST, DOWN, NORTH)),
        # Stabilised against bank and pitch.
        (_attitude(roll=25, pitch=-15), _gimbal(0), (EAST, DOWN, NORTH)),
        # Screwed on, right wing down: the image's right is towards the ground.
        (_attitude(roll=90), _gimbal(0, 0, "body"), (DOWN, -EAST, NORTH)),
    ],
)
def test_camera_axes_point_where_they_should(body, gimbal, axes) -> None:
    R = camera_attitude(body, gimbal, LEVEL)
    np.testing.assert_allclose(R, np.column_stack(axes), atol=1e-12)


def test_the_lever_arm_turns_with_the_body() -> None:
    arm = (1.0, 0.0, 0.5)  # one metre ahead, half below
    body = _attitude(yaw=90)
    pose = world_from_camera((10, 20, 30), body, camera_attitude(body, _gimbal(-90), LEVEL), arm)
    np.testing.assert_allclose(pose.translation, [11, 20, 29.5], atol=1e-12)


def test_agrees_with_the_pose_files_angles() -> None:
    """As PiLoT has it: pitch 0 is the nadir, yaw counter-clockwise from north."""
    frame = LocalFrame(Geodetic(47.0, 8.0, 400.0))
    body = _attitude(roll=3, pitch=5, yaw=70)
    R = camera_attitude(body, _gimbal(-50), LEVEL)
    row = pose_row("a", world_from_camera((0, 0, 0), body, R, (0, 0, 0)), frame)
    assert row.pitch_deg == pytest.approx(40)
    assert row.yaw_deg == pytest.approx(-70)
    assert row.roll_deg == pytest.approx(0, abs=1e-9)


def test_ned_at_a_far_point_is_turned_by_the_earths_curvature() -> None:
    frame = LocalFrame(Geodetic(47.0, 8.0, 400.0))
    np.testing.assert_allclose(frame.ned_from_enu(frame.origin), NED_FROM_ENU, atol=1e-12)
    north = frame.position([0.0, 10_000.0, 0.0])
    down = frame.ned_from_enu(north)[2]  # in the map's axes
    # Down at a point further north leans back to the south, by 10 km over the meridian's radius.
    assert down[1] == pytest.approx(-10_000 / 6_370_000, rel=0.01)
    assert down[2] == pytest.approx(-1, abs=1e-5)
    R = frame.ned_from_enu(frame.position([20_000.0, 0.0, 0.0]))
    tilt = math.degrees(math.acos((np.trace(R @ NED_FROM_ENU.T) - 1) / 2))
    assert 0.2 < tilt < 0.4  # 20 km east: 0.18° of tilt and 0.2° of convergence


# --- conversions --------------------------------------------------------------------------------


ORIGIN = Geodetic(47.3, 8.5, 450.0)
FRAME = LocalFrame(ORIGIN)
LEVER = np.array([0.4, -0.1, 0.2])
SEPARATION = 47.5
INSTALLATION = CameraExtrinsics(FRAME, SEPARATION, LEVER)


def _attitude_conversions(roll, pitch, yaw) -> Attitude:
    q = quaternion_from_matrix(matrix_from_euler(roll, pitch, yaw))
    return Attitude(0, roll, pitch, yaw, tuple(float(x) for x in q))


def _gimbal_conversions(pitch, yaw) -> GimbalAttitude:
    q = quaternion_from_matrix(matrix_from_euler(0.0, pitch, yaw))
    return GimbalAttitude(0, 0.0, pitch, yaw, tuple(float(x) for x in q), "test")


def _state(position: Geodetic, velocity=None) -> VehicleState:
    return VehicleState(
        connected=True, latitude_deg=position.latitude_deg, longitude_deg=position.longitude_deg,
        altitude_amsl_m=position.height_m - SEPARATION, local_velocity_ned=velocity,
    )  # fmt: skip


def _prior(state, attitude, gimbal, time_ns=0):
    return vehicle_prior(state, attitude, gimbal, INSTALLATION, (5.0, 0.1), time_ns)


@pytest.mark.parametrize("seed", range(5))
def test_fix_of_the_prior_is_the_vehicle_again(seed):
    rng = np.random.default_rng(seed)
    attitude = _attitude_conversions(*rng.uniform(-0.4, 0.4, 2), rng.uniform(-3, 3))
    gimbal = _gimbal_conversions(rng.uniform(-1.5, -0.2), rng.uniform(-3, 3))
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
    attitude, gimbal = _attitude_conversions(0, 0, 0), _gimbal_conversions(-1.5, 0)
    prior = _prior(_state(ORIGIN), attitude, gimbal)
    estimate = estimated(prior.world_from_camera, covariance=prior.covariance, quality=0.9)
    fix = vision_fix(estimate, INSTALLATION, attitude, None, 3)
    assert fix.quaternion is None
    assert fix.yaw_rad is None
    assert fix.reset_count == 3
    # It is the camera's place that is told for the vehicle's: off by the lever arm, no one knows
    # which way, and within its covariance.
    known = vision_fix(estimate, INSTALLATION, attitude, gimbal, 3)
    wider = fix.position_covariance_ned - known.position_covariance_ned
    np.testing.assert_allclose(wider, np.eye(3) * (LEVER @ LEVER), atol=1e-9)


def test_prior_follows_the_velocity_and_refuses_old_or_missing_positions():
    moving = _state(ORIGIN, velocity=(10.0, 0.0, 0.0))
    a, g = _attitude_conversions(0, 0, 0), _gimbal_conversions(-1.5, 0)
    now, later = _prior(moving, a, g, 0), _prior(moving, a, g, 500_000_000)
    moved = later.world_from_camera.translation - now.world_from_camera.translation
    np.testing.assert_allclose(moved, [0.0, 5.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(later.velocity, [0.0, 10.0, 0.0], atol=1e-6)
    assert _prior(_state(ORIGIN), a, g).velocity is None
    assert _prior(moving, a, g, 5_000_000_000) is None
    assert _prior(moving, None, g) is None
    assert _prior(VehicleState(), a, g) is None
