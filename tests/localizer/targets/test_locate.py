import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.pick import BundleHits, cast_bundle
from localizer.targets.locate import locate, ray_in_world, ray_spread, surface_covariance
from localizer.targets.track import TargetSettings, TargetTrack
from localizer.types import PoseEstimate, RegistrationStatus, TrackingState
from tests.companion.targets.scene import square

CAMERA = Camera(640, 480, 550.0, 550.0, 322.0, 238.0, (-0.1, 0.02, 0.001, -0.001, 0.0))
NADIR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([10.0, 20.0, 120.0]))
EXACT = np.eye(6) * 1e-12


def _estimate(pose: Pose, covariance=None) -> PoseEstimate:
    P = np.diag([0.5, 0.4, 0.8, 0.004, 0.005, 0.006]) ** 2 if covariance is None else covariance
    return PoseEstimate(
        pose, P, 1.0, TrackingState.TRACKING, RegistrationStatus.OK, True, 0, 0, CAMERA
    )


def _ground_hit(pose: Pose, pixel) -> np.ndarray:
    origin, direction = ray_in_world(_estimate(pose), pixel)
    return origin - direction * origin[2] / direction[2]


MESHES = [square(400.0, 0.0), square(20.0, 8.0)]


def _cast(origin, directions) -> BundleHits:
    return cast_bundle(MESHES, origin, directions)


def _pixel_of(pose: Pose, point) -> tuple[float, float]:
    u, v = CAMERA.project(pose.inverse.apply(np.array(point)))[0]
    return float(u), float(v)


def test_ray_meets_the_point_that_projects_to_the_pixel():
    point = np.array([25.0, 5.0, 0.0])
    np.testing.assert_allclose(_ground_hit(NADIR, _pixel_of(NADIR, point)), point, atol=1e-4)


def test_a_pixel_on_one_surface_is_placed_exactly():
    point = np.array([25.0, 5.0, 0.0])
    surfaces = locate(_estimate(NADIR), _pixel_of(NADIR, point), _cast, 1.5, 0.3)
    assert [s.probability for s in surfaces] == [1.0]
    np.testing.assert_allclose(surfaces[0].position, point, atol=1e-4)


def test_at_a_roof_s_edge_both_surfaces_are_told_with_what_is_likely():
    seen = []
    for east in (9.0, 9.9, 10.0, 10.1, 11.0):
        pixel = _pixel_of(NADIR, (east, 3.0, 8.0))
        surfaces = locate(_estimate(NADIR, EXACT), pixel, _cast, 1.5, 0.3)
        for s in surfaces:
            height = round(float(s.position[2]))
            assert height in (0, 8)  # and nothing in mid-air
            assert s.position[2] == pytest.approx(height, abs=1e-6)
        seen.append(sum(s.probability for s in surfaces if s.position[2] > 4.0))
    # A pixel covers 0.2 m of the roof, its error 1.5 pixels (0.3 m).
    assert seen == sorted(seen, reverse=True)
    assert seen[0] == 1.0
    assert seen[-1] == 0.0
    assert seen[2] == pytest.approx(0.5, abs=0.3)  # the middle node of the bundle is on one side


def test_the_shares_of_an_edge_are_those_of_monte_carlo():
    rng = np.random.default_rng(1)
    estimate = _estimate(NADIR)
    pixel = _pixel_of(NADIR, (9.6, 3.0, 8.0))
    sigma = np.sqrt(estimate.covariance.diagonal())
    heights = []
    for _ in range(500):
        e = rng.normal(0, sigma)
        moved = Pose(so3_exp(e[3:]) @ NADIR.rotation, NADIR.translation + e[:3])
        at = (pixel[0] + rng.normal(0, 1.5), pixel[1] + rng.normal(0, 1.5))
        origin, direction = ray_in_world(_estimate(moved), at)
        heights.append(origin[2] + direction[2] * _cast(origin, direction[None, :]).distances[0])
    roof = float(np.mean(np.array(heights) > 4.0))
    surfaces = locate(estimate, pixel, _cast, 1.5, 0.3)
    found = next(s for s in surfaces if s.position[2] > 4.0)
    assert 0.6 < roof < 0.9
    assert found.probability == pytest.approx(roof, abs=0.15)


def test_a_pixel_in_the_sky_shows_no_surface():
    up = Pose(np.eye(3), np.array([0.0, 0.0, 50.0]))  # looks along +z
    assert locate(_estimate(up), (320.0, 240.0), _cast, 1.5, 0.3) == ()


@pytest.mark.parametrize("tilt_deg", [0.0, 45.0])
def test_covariance_agrees_with_monte_carlo(tilt_deg):
    pose = Pose(so3_exp([np.radians(tilt_deg), 0, 0]) @ NADIR.rotation, NADIR.translation)
    pixel = (200.0, 300.0)
    estimate = _estimate(pose)
    offset = _ground_hit(pose, pixel) - pose.translation
    spread = ray_spread(estimate, pixel, 2.0, float(np.linalg.norm(offset)))
    P = surface_covariance(offset, np.array([0.0, 0.0, 1.0]), spread, map_sigma_m=1e-9)
    rng = np.random.default_rng(0)
    sigma = np.sqrt(estimate.covariance.diagonal())
    hits = []
    for _ in range(2000):
        e = rng.normal(0, sigma)
        moved = Pose(so3_exp(e[3:]) @ pose.rotation, pose.translation + e[:3])
        hits.append(_ground_hit(moved, tuple(np.add(pixel, rng.normal(0, 2.0, 2)))))
    sampled = np.cov(np.array(hits).T)
    np.testing.assert_allclose(P[:2, :2], sampled[:2, :2], rtol=0.12, atol=0.02)


def test_what_strays_from_the_tangent_plane_widens_the_covariance():
    def steps(origin, directions):
        """Ground with steps of 0.7 m, too low to be told apart as surfaces."""
        hits = _cast(origin, directions)
        east = (origin + directions * hits.distances[:, None])[:, 0]
        down = -directions[:, 2]
        return BundleHits(hits.distances + 0.7 * (np.floor(east * 4) % 2) / down, hits.normals)

    pixel = _pixel_of(NADIR, (30.0, 5.0, 0.0))
    flat = locate(_estimate(NADIR, EXACT), pixel, _cast, 1.5, 0.1)
    rough = locate(_estimate(NADIR, EXACT), pixel, steps, 1.5, 0.1)
    assert len(flat) == len(rough) == 1
    assert rough[0].covariance[2, 2] > flat[0].covariance[2, 2] + 0.2**2


def _roofs(half_m):
    """A roof at 8 m over ground, both about the origin: half its side."""
    meshes = [square(400.0, 0.0), square(2.0 * half_m, 8.0)]
    return lambda origin, directions: cast_bundle(meshes, origin, directions)


def _told(today_half_m, east, **settings):
    """(error, its share of the bound, sigma) of a click at what is seen through (east, 3, 8).

    The map's roof ends at 10 m.
    """
    oblique = Pose(so3_exp([np.radians(40), 0, 0]) @ NADIR.rotation, np.array([0.0, -75.0, 90.0]))
    estimate = _estimate(oblique, np.diag([0.06, 0.06, 0.06, 5e-4, 5e-4, 5e-4]) ** 2)
    pixel = _pixel_of(oblique, (east, 3.0, 8.0))
    track = TargetTrack("click", TargetSettings(confirm_s=0.0, **settings), _roofs(10.0))
    fix = track.observe(estimate, pixel)
    eye, ray = ray_in_world(estimate, pixel)
    truth = eye + ray * _roofs(today_half_m)(eye, ray[None]).distances[0]
    off = fix.position_world - truth
    bound = float(off @ np.linalg.solve(fix.covariance, off)) / 7.815  # 95 % of three dimensions
    return float(np.linalg.norm(off)), bound, float(np.sqrt(np.trace(fix.covariance)))


@pytest.mark.parametrize(("outline_m", "east"), [(8.0, 8.6), (8.2, 8.7), (12.0, 11.4)])
def test_beside_an_outline_that_lies_elsewhere_today_the_error_says_so(outline_m, east):
    """Attack: without the outline's error a roof's edge is told 9 m off, known to 0.6 m."""
    error, bound, sigma = _told(outline_m, east, outline_sigma_m=0.0)
    assert error > 8.0
    assert bound > 2.0
    error, bound, sigma = _told(outline_m, east)
    assert bound < 1.0
    assert sigma > 2.5


@pytest.mark.parametrize("east", [0.0, 6.0, 16.0])
def test_in_the_middle_of_a_roof_or_a_field_the_outlines_error_says_nothing(east):
    plain, told = _told(10.0, east, outline_sigma_m=0.0), _told(10.0, east)
    assert told == pytest.approx(plain, rel=0.02)
    assert told[2] < 0.85
