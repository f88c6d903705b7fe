import numpy as np
import pytest

from localizer.camera import Camera
from localizer.map.tile import TileMesh
from localizer.pose import Pose, so3_exp
from localizer.targets import (
    SurfacePoint,
    TargetFilter,
    cast_ray,
    ray_in_world,
    target_covariance,
)
from localizer.types import PoseEstimate, RegistrationStatus, TargetFix, TrackingState

CAMERA = Camera(640, 480, 550.0, 550.0, 322.0, 238.0, (-0.1, 0.02, 0.001, -0.001, 0.0))
NADIR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([10.0, 20.0, 120.0]))


def _estimate(pose: Pose, covariance=None) -> PoseEstimate:
    P = np.diag([0.5, 0.4, 0.8, 0.004, 0.005, 0.006]) ** 2 if covariance is None else covariance
    return PoseEstimate(
        pose, P, 1.0, TrackingState.TRACKING, RegistrationStatus.OK, True, 0, 0, CAMERA
    )


def _ground_hit(pose: Pose, pixel) -> np.ndarray:
    origin, direction = ray_in_world(_estimate(pose), pixel)
    return origin - direction * origin[2] / direction[2]


def test_ray_meets_the_point_that_projects_to_the_pixel():
    point = np.array([25.0, 5.0, 0.0])
    pixel, inside = CAMERA.project(NADIR.inverse.apply(point))
    assert inside
    np.testing.assert_allclose(_ground_hit(NADIR, tuple(pixel)), point, atol=1e-4)


def _square(side: float, height: float) -> TileMesh:
    """A horizontal square about the origin, with a plain texture."""
    corners = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) * side / 2
    return TileMesh(
        np.column_stack([corners, np.full(4, height)]).astype(np.float32),
        np.zeros((4, 2), np.float32),
        np.array([[0, 1, 2], [1, 3, 2]], np.int32),
        (np.zeros((4, 4, 3), np.uint8),),
        Pose.identity(),
    )


def test_a_ray_beside_a_roofs_edge_meets_the_ground_and_one_inside_it_the_roof():
    meshes = [_square(400.0, 0.0), _square(20.0, 8.0)]
    eye = np.array([40.0, 5.0, 120.0])
    for east, height in ((9.98, 8.0), (10.02, 0.0)):
        direction = np.array([east, 3.0, 8.0]) - eye
        hit = cast_ray(meshes, eye, direction / np.linalg.norm(direction))
        assert hit is not None
        # A pixel there covers 0.2 m: depth interpolated in an image would hang in between.
        assert hit.position[2] == pytest.approx(height, abs=1e-4)


@pytest.mark.parametrize("tilt_deg", [0.0, 45.0])
def test_covariance_agrees_with_monte_carlo(tilt_deg):
    pose = Pose(so3_exp([np.radians(tilt_deg), 0, 0]) @ NADIR.rotation, NADIR.translation)
    pixel = (200.0, 300.0)
    estimate = _estimate(pose)
    hit = SurfacePoint(_ground_hit(pose, pixel), np.array([0.0, 0.0, 1.0]))
    P = target_covariance(estimate, hit, pixel_sigma=2.0, map_sigma_m=1e-9)
    rng = np.random.default_rng(0)
    sigma = np.sqrt(estimate.covariance.diagonal())
    hits = []
    for _ in range(4000):
        e = rng.normal(0, sigma)
        moved = Pose(so3_exp(e[3:]) @ pose.rotation, pose.translation + e[:3])
        hits.append(_ground_hit(moved, tuple(np.add(pixel, rng.normal(0, 2.0, 2)))))
    sampled = np.cov(np.array(hits).T)
    np.testing.assert_allclose(P[:2, :2], sampled[:2, :2], rtol=0.12, atol=0.02)


def test_filter_follows_a_moving_target_and_survives_an_outlier():
    rng = np.random.default_rng(3)
    target = TargetFilter()
    velocity = np.array([6.0, -2.0, 0.0])
    for k in range(60):
        truth = velocity * k * 0.2
        noise = rng.normal(0, 1.0, 3) + (30.0 if k == 40 else 0.0)
        fix = TargetFix("car", truth + noise, np.eye(3), (0.0, 0.0), round(k * 0.2e9))
        out = target.update(fix)
    assert np.linalg.norm(out.position_world - truth) < 1.5
    np.testing.assert_allclose(target.velocity, velocity, atol=1.0)


def test_filter_restarts_on_a_target_that_really_moved():
    target = TargetFilter()
    for k in range(20):
        position = np.zeros(3) if k < 10 else np.array([200.0, 0.0, 0.0])
        out = target.update(TargetFix("t", position, np.eye(3) * 0.1, (0, 0), round(k * 0.2e9)))
    np.testing.assert_allclose(out.position_world, [200.0, 0.0, 0.0], atol=1.0)
