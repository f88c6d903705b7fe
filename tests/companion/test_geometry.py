"""The chain from vehicle to camera, held to cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry import (
    GimbalAngles,
    GimbalFrame,
    Mount,
    camera_attitude,
    ned_from_world,
    world_from_camera,
)
from localizer.geometry.geo import NED_FROM_ENU, Geodetic, LocalFrame
from localizer.geometry.pose import matrix_from_euler
from localizer.geometry.posefile import pose_row

LEVEL = Mount.from_degrees()
NORTH, EAST, DOWN = np.eye(3)


def _attitude(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    return matrix_from_euler(*np.radians([roll, pitch, yaw]))


def _gimbal(pitch: float, yaw: float = 0.0, frame: str = "heading") -> GimbalAngles:
    return GimbalAngles(0.0, np.radians(pitch), np.radians(yaw), GimbalFrame(frame))


# Camera axes in NED as (right, down, forward).
CASES = {
    "forward, heading north": (_attitude(), _gimbal(0), (EAST, DOWN, NORTH)),
    "forward, heading east": (_attitude(yaw=90), _gimbal(0), (-NORTH, DOWN, EAST)),
    "nadir, heading north": (_attitude(), _gimbal(-90), (EAST, -NORTH, DOWN)),
    "nadir, heading east": (_attitude(yaw=90), _gimbal(-90), (-NORTH, -EAST, DOWN)),
    "gimbal to the right, heading north": (_attitude(), _gimbal(0, 90), (-NORTH, DOWN, EAST)),
    "gimbal right of east": (_attitude(yaw=90), _gimbal(0, 90), (-EAST, DOWN, -NORTH)),
    "earth frame ignores the heading": (
        _attitude(yaw=90),
        _gimbal(0, 0, "earth"),
        (EAST, DOWN, NORTH),
    ),
    "stabilised against bank and pitch": (
        _attitude(roll=25, pitch=-15),
        _gimbal(0),
        (EAST, DOWN, NORTH),
    ),
    "screwed on, banked right by 90": (_attitude(roll=90), _gimbal(0, 0, "body"), None),
}


@pytest.mark.parametrize("name", CASES)
def test_camera_axes_point_where_they_should(name: str) -> None:
    body, gimbal, axes = CASES[name]
    R = camera_attitude(body, gimbal, LEVEL)
    # Right wing down: the image's right is towards the ground, its down is to the west.
    expected = (DOWN, -EAST, NORTH) if axes is None else axes
    np.testing.assert_allclose(R, np.column_stack(expected), atol=1e-12)


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
    np.testing.assert_allclose(ned_from_world(frame, frame.origin), NED_FROM_ENU, atol=1e-12)
    north = frame.position([0.0, 10_000.0, 0.0])
    down = ned_from_world(frame, north)[2]  # in the map's axes
    # Down at a point further north leans back to the south, by 10 km over the meridian's radius.
    assert down[1] == pytest.approx(-10_000 / 6_370_000, rel=0.01)
    assert down[2] == pytest.approx(-1, abs=1e-5)
