"""What a calibration leaves unknown: held to poses that are fitted with a wrong camera."""

from dataclasses import replace

import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp, so3_log
from localizer.geometry.shutter import Sweep
from localizer.registration.calibration import CalibrationSigmas, calibration_covariance

CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0, readout_ms=20.0)
POSE = Pose(so3_exp([0.5, 0.1, 0.3]) @ np.diag([1.0, -1.0, -1.0]), np.array([400.0, -90.0, 130.0]))
STILL = (np.zeros(3), np.zeros(3))
NOTHING = CalibrationSigmas.none()


def _scene() -> np.ndarray:
    rng = np.random.default_rng(3)
    rays = CAMERA.rays(rng.uniform((4, 4), (316, 236), (900, 2))) @ POSE.rotation.T
    depth = (rng.uniform(0, 20, 900) - POSE.translation[2]) / rays[:, 2]
    return POSE.translation + rays * depth[:, None]


def _fitted(pixels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(6,) by which the pose that fits pixels best, by Gauss and Newton, is off the true one."""
    pose = POSE
    for _ in range(8):
        steps = np.concatenate([1e-3 * np.eye(6)[:3], 1e-6 * np.eye(6)[3:]])
        base, _ = CAMERA.project(pose.inverse.apply(points))
        J = np.stack(
            [
                (CAMERA.project(_moved(pose, s).inverse.apply(points))[0] - base).ravel() / s.sum()
                for s in steps
            ],
            axis=1,
        )
        step = np.linalg.lstsq(J, (pixels - base).ravel(), rcond=None)[0]
        pose = _moved(pose, step)
    turn = so3_log(pose.rotation @ POSE.rotation.T)
    return np.concatenate([pose.translation - POSE.translation, turn])


def _moved(pose: Pose, step: np.ndarray) -> Pose:
    return Pose(so3_exp(step[3:]) @ pose.rotation, pose.translation + step[:3])


@pytest.mark.parametrize(
    ("sigmas", "true"),
    [
        ({"focal_percent": 0.2}, replace(CAMERA, fx=250.5, fy=250.5)),
        ({"distortion": 0.004}, replace(CAMERA, distortion=(0.004, 0.0, 0.0, 0.0, 0.0))),
    ],
)
def test_a_number_that_is_off_moves_the_pose_by_what_its_sigma_says(sigmas, true):
    points = _scene()
    off = _fitted(true.project(POSE.inverse.apply(points))[0], points)
    known = NOTHING.model_copy(update=sigmas)
    covariance = calibration_covariance(known, points, POSE, CAMERA, None, STILL)
    own = np.sqrt(covariance.diagonal())
    assert np.linalg.norm(off[:3]) > 0.05
    assert np.all(np.abs(off) <= 1.1 * own + 1e-6)  # k2 of the same sigma adds its own
    if "focal_percent" in sigmas:
        assert np.allclose(np.abs(off[:3]), own[:3], rtol=0.05, atol=0.005)


def test_a_principal_point_a_pixel_off_is_told_as_metres_beside():
    points = _scene()
    known = NOTHING.model_copy(update={"principal_percent": 100.0 * 0.35 / 320})
    errors = [
        _fitted(CAMERA.project(POSE.inverse.apply(points))[0] + shift, points)
        for shift in ((0.35, 0.0), (0.0, 0.35))
    ]
    wanted = sum(np.outer(e, e) for e in errors)
    covariance = calibration_covariance(known, points, POSE, CAMERA, None, STILL)
    # Of every other point, so nearly: each by the sigmas of its two axes.
    scale = np.sqrt(np.outer(wanted.diagonal(), wanted.diagonal()))
    assert np.abs(covariance - wanted).max() < 0.15 * scale.max()
    assert np.allclose(covariance.diagonal(), wanted.diagonal(), rtol=0.15)
    assert 0.1 < np.sqrt(covariance[0, 0] + covariance[1, 1]) < 0.5


def test_readout_and_stamps_tell_only_while_the_camera_moves():
    points = _scene()
    known = NOTHING.model_copy(update={"readout_ms": 2.0, "stamp_ms": 5.0})
    rate, velocity = np.radians([60.0, 0.0, 0.0]), np.array([10.0, 0.0, 0.0])
    sweep = Sweep.of(rate, velocity, CAMERA.readout_ms)
    moving = calibration_covariance(known, points, POSE, CAMERA, sweep, (velocity, rate))
    rest = Sweep.of(np.zeros(3), np.zeros(3), CAMERA.readout_ms)
    still = calibration_covariance(known, points, POSE, CAMERA, rest, STILL)
    late = calibration_covariance(
        known, points, POSE, replace(CAMERA, readout_ms=0.0), None, (velocity, rate)
    )
    assert not still.any()
    assert np.sqrt(late[0, 0]) == pytest.approx(0.05)
    assert np.sqrt(late[3, 3]) == pytest.approx(np.radians(0.3))
    assert np.trace(moving[:3, :3]) > np.trace(late[:3, :3]) + 0.01


def test_points_that_hold_no_pose_add_nothing_but_time():
    known = CalibrationSigmas()
    far = np.repeat(_scene()[:1], 50, axis=0)
    for points in (np.zeros((0, 3)), far):
        assert not calibration_covariance(known, points, POSE, CAMERA, None, STILL).any()


def test_a_displaced_surface_moves_the_pose_as_its_patches_do():
    """Against draws: every 6 m square of the ground displaced by itself, the pose fitted."""
    points, rng = _scene(), np.random.default_rng(8)
    known = NOTHING.model_copy(update={"map_m": 0.1, "map_length_m": 6.0})
    wanted = np.sqrt(calibration_covariance(known, points, POSE, CAMERA, None, STILL).diagonal())
    square = np.floor(points[:, :2] / 6.0).astype(int)
    _, patch = np.unique(square, axis=0, return_inverse=True)
    patch, errors = patch.ravel(), []
    for _ in range(40):
        moved = points + rng.normal(0, 0.1, (patch.max() + 1, 3))[patch]
        pixels, _ = CAMERA.project(POSE.inverse.apply(moved))
        errors.append(_fitted(pixels, points))
    found = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all(found < 1.6 * wanted)
    assert np.all(found > 0.5 * wanted)
