"""A rolling shutter: where a moving camera sees a point, held to the row's own pose."""

import numpy as np
import pytest

from localizer.errors import CameraError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.geometry.shutter import Sweep

CAMERA = Camera(640, 480, 500.0, 505.0, 322.0, 238.0, (-0.09, 0.02, 6e-4, -4e-4, 0.0), 20.0)
DOWN = Pose(np.diag([1.0, -1.0, -1.0]), np.array([40.0, -20.0, 120.0]))
RATE, VELOCITY = np.radians([60.0, -20.0, 45.0]), np.array([9.0, -4.0, 1.0])


def _ground(count: int = 300) -> np.ndarray:
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-55, 55, (count, 2)), rng.uniform(0, 25, count)])
    return points + np.array([40.0, -20.0, 0.0])


def _pixels_row_by_row(points: np.ndarray) -> np.ndarray:
    """Each point projected from the pose at the time at which its own row is read out."""
    seen = []
    for point in points:
        row = CAMERA.height / 2
        for _ in range(30):
            time_s = (row / CAMERA.height - 0.5) * 1e-3 * CAMERA.readout_ms
            turned = so3_exp(RATE * time_s) @ DOWN.rotation
            pose = Pose(turned, DOWN.translation + VELOCITY * time_s)
            pixel, _ = CAMERA.project(pose.inverse.apply(point))
            row = float(np.clip(pixel[1], 0, CAMERA.height))
        seen.append(pixel)
    return np.array(seen)


def test_the_moved_points_are_seen_where_the_rolling_camera_sees_the_true_ones():
    points, sweep = _ground(), Sweep.of(RATE, VELOCITY, CAMERA.readout_ms)
    rolled = _pixels_row_by_row(points)
    still, inside = CAMERA.project(DOWN.inverse.apply(points))
    moved, _ = CAMERA.project(DOWN.inverse.apply(sweep.apparent_points(points, DOWN, CAMERA)))
    assert np.linalg.norm(still - rolled, axis=1)[inside].max() > 4.0  # what is mended
    assert np.linalg.norm(moved - rolled, axis=1)[inside].max() < 0.05


def test_a_camera_that_stands_still_sweeps_nothing():
    points, still = _ground(), Sweep.of(np.zeros(3), np.zeros(3), 20.0)
    assert np.allclose(still.apparent_points(points, DOWN, CAMERA), points, atol=1e-9)
    assert not still.displaces_pixels(CAMERA, 120.0)
    assert not Sweep.of(RATE, VELOCITY, 0.0).displaces_pixels(CAMERA, 120.0)
    assert Sweep.of(np.zeros(3), VELOCITY, 20.0).displaces_pixels(CAMERA, 120.0)


@pytest.mark.parametrize("readout_ms", [-1.0, 1e4, float("nan")])
def test_a_readout_that_no_shutter_has_is_named(readout_ms):
    with pytest.raises(CameraError, match="readout"):
        Camera(640, 480, 500, 500, 320, 240, readout_ms=readout_ms)


def test_the_readout_is_kept_in_camera_files_and_sizes():
    assert Camera.from_dict(CAMERA.to_dict()) == CAMERA
    assert CAMERA.resized(320, 240).without_distortion().readout_ms == 20.0
