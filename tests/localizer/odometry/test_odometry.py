"""Carrying a pose on: how far off it is, what it says of itself, and when it stops."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from localizer.device_array import DeviceArray
from localizer.errors import DeviceArrayError, OdometryError
from localizer.geometry.pose import Array, Pose, hat, so3_exp, so3_log
from localizer.odometry.config import OdometryConfig
from localizer.odometry.estimate import OdometryStatus
from localizer.odometry.ground import (
    FlatGround,
    RangefinderGround,
    TerrainModel,
    ground_points,
    height_above_ground,
)
from localizer.odometry.keyframe import DepthSource, keyframe_anchors
from localizer.odometry.odometry import VisualOdometry
from localizer.odometry.parallax import ParallaxAlignment, ParallaxView, align
from localizer.odometry.usability import ImageFault, find_fault
from localizer.registration.cpu.kernel import NumbaBackend
from localizer.registration.jngo import JNGO
from localizer.registration.priors import (
    PoseConstraint,
    attitude_constraint,
    combine,
    height_constraint,
)
from localizer.registration.sampling import sample_features
from localizer.types import GroundUncertainty
from tests.localizer.odometry.conftest import BEGUN, CAMERA, STEP_NS, VELOCITY, Flight
from tests.localizer.registration.conftest import SyntheticPlace, camera_pose


def odometry(
    ground: TerrainModel | None = None,
    uncertainty: GroundUncertainty | None = None,
    **changes: object,
) -> VisualOdometry:
    config = OdometryConfig(**{"anchors": 600, **changes})
    return VisualOdometry(CAMERA, JNGO(threads=1), config, ground, uncertainty=uncertainty)


def begun(flight: Flight, vo: VisualOdometry, *, mapped: bool, **more) -> VisualOdometry:
    surface = flight.surface(0) if mapped else None
    vo.begin(flight.frame(0), flight.pose(0), BEGUN, velocity=VELOCITY, surface=surface, **more)
    return vo


def horizontal(pose: Pose, truth: Pose) -> float:
    return float(np.linalg.norm((pose.translation - truth.translation)[:2]))


def test_the_maps_geometry_carries_the_pose_on(hills):
    vo = begun(hills, odometry(), mapped=True)
    radii = []
    for k in range(1, 26):
        estimate = vo.step(hills.frame(k), surface=hills.surface(k))
        assert estimate.status is OdometryStatus.OK, estimate.reason
        assert estimate.source is DepthSource.MAP
        error = estimate.world_from_camera.translation - hills.pose(k).translation
        P = estimate.covariance[:3, :3]
        assert error @ np.linalg.solve(P, error) < 16.3, k  # 99.9 % of three degrees of freedom
        radii.append(estimate.drift_m)
    assert horizontal(estimate.world_from_camera, hills.pose(25)) < 0.01 * 100
    assert estimate.bridged_s == pytest.approx(10.0)
    assert estimate.way_m == pytest.approx(100, rel=0.03)
    assert estimate.keyframe_age_s < 8.0  # others took over on the way
    assert radii[-1] > radii[10] > radii[0] > 0
    assert radii[-1] < 0.1 * 100  # small pictures, and no sensor helps


def test_what_did_not_match_stays_uncertain_whatever_other_sensors_say(hills):
    """At night sensors and the map's shape held the sigma at 1.8 m while the place drifted 13 m."""

    def flown(unmatched: float) -> list:
        model = replace(OdometryConfig().with_map, unmatched=unmatched)
        sensed = [
            combine(
                attitude_constraint(hills.pose(k).rotation, 0.001, 0.002),
                height_constraint(hills.pose(k).translation[2], 0.1),
            )
            for k in range(13)
        ]
        vo = begun(hills, odometry(with_map=model), mapped=True, constraint=sensed[0])
        return [
            vo.step(hills.frame(k), surface=hills.surface(k), constraint=sensed[k])
            for k in range(1, 13)
        ]

    without, given = flown(0.0), flown(1.0)
    added = []
    for a, b in zip(without, given, strict=True):
        assert b.usable
        np.testing.assert_array_equal(a.world_from_camera.matrix, b.world_from_camera.matrix)
        more = b.covariance - a.covariance
        np.testing.assert_allclose(more, more[0, 0] * np.diag([1, 1, 0, 0, 0, 0]), atol=1e-12)
        added.append(more[0, 0])
    worst = max(1 - e.quality for e in given)
    assert (np.diff(added) > -0.1 * added[-1]).all()  # the way since the keyframe is of one frame
    assert 0 < added[-1] <= worst**2 * given[-1].way_m
    assert given[-1].drift_m > without[-1].drift_m


def test_a_ground_without_relief_is_enough(plain):
    vo = begun(plain, odometry(FlatGround(0.0)), mapped=False)
    for k in range(1, 26):
        estimate = vo.step(plain.frame(k))
        assert estimate.usable, estimate.reason
    assert estimate.source is DepthSource.GROUND
    error = horizontal(estimate.world_from_camera, plain.pose(25))
    assert error < 0.02 * 100
    assert error < estimate.drift_m < 0.3 * 100  # small pictures, and no sensor helps


def test_at_the_maps_edge_the_ground_goes_on_at_the_last_height(plain):
    vo = begun(plain, odometry(), mapped=True)
    sources = []
    for k in range(1, 21):
        estimate = vo.step(plain.frame(k), surface=plain.surface(k) if k < 6 else None)
        assert estimate.usable, estimate.reason
        sources.append(estimate.source)
    assert sources[0] is DepthSource.MAP
    assert sources[-1] is DepthSource.PLANE
    assert horizontal(estimate.world_from_camera, plain.pose(20)) < 0.02 * 80


@pytest.mark.parametrize("rise_m", [30.0, -40.0])
def test_over_hills_way_and_velocity_err_as_they_claim(rise_m: float):
    """240 m over ground that rises, or falls, by so much of the 100 m below. With a tenth of the
    velocity for its sigma, what was sent was off by 3.9 sigma.
    """
    place = SyntheticPlace.from_seed(7, relief_m=0.6)
    hill = np.array([[rise_m, 0.0, 2 * np.pi / 1000, 0.0]])
    flight = Flight(replace(place, hills=np.vstack([place.hills, hill])))

    def sensed(k: int) -> PoseConstraint:
        pose = flight.pose(k)
        attitude = attitude_constraint(pose.rotation, np.radians(0.3), np.radians(1.0))
        return combine(attitude, height_constraint(pose.translation[2], 0.5))

    vo = odometry(max_sigma_m=20.0, uncertainty=GroundUncertainty(grade=abs(rise_m) / 250.0))
    begun(flight, vo, mapped=True, constraint=sensed(0))
    before, normalised, scales = np.zeros(3), [], []
    for k in range(2, 62, 2):
        estimate = vo.step(flight.frame(k), constraint=sensed(k))
        assert estimate.usable, estimate.reason
        error = estimate.world_from_camera.translation - flight.pose(k).translation
        P = estimate.covariance[:2, :2]
        assert error[:2] @ np.linalg.solve(P, error[:2]) < 9.0, k
        if k % 10 == 0:  # 4 s: what a registration is off counts little
            speed = np.hypot(*(error - before)[:2]) / 4.0
            normalised.append(speed / np.hypot(0.3, estimate.scale_sigma * 10.0))
            before = error
        scales.append(estimate.scale_sigma)
    assert 0.5 < max(normalised) < 3.0
    assert estimate.source is DepthSource.PLANE
    assert scales[-1] > 0.2  # 2 m/s of 10: more than the autopilot can be told
    assert scales[5] < 0.1


def test_the_way_over_the_map_is_not_told_to_be_over_level_ground(plain):
    vo = begun(plain, odometry(), mapped=True)
    for k in range(1, 16):
        estimate = vo.step(plain.frame(k), surface=plain.surface(k))
    on_map = estimate.covariance[1, 1] ** 0.5
    for k in range(16, 19):  # the keyframe of the map serves on
        estimate = vo.step(plain.frame(k))
    assert estimate.covariance[1, 1] ** 0.5 < on_map + 0.5


def slope() -> Flight:
    """Ground that rises by 15 m within 125 m of the way."""
    place = SyntheticPlace.from_seed(7, relief_m=0.6)
    rise = np.array([[15.0, 0.0, 2 * np.pi / 500, 0.0]])
    return Flight(replace(place, hills=np.vstack([place.hills, rise])))


def carried_over(flight: Flight, above: Callable[[int], float | None]) -> float:
    """Horizontal error after 100 m of which the map knows the first."""
    vo = begun(flight, odometry(max_sigma_m=10.0), mapped=True)
    for k in range(1, 26):
        estimate = vo.step(flight.frame(k), clearance_m=above(k))
        assert estimate.usable, estimate.reason
    return horizontal(estimate.world_from_camera, flight.pose(25))


def test_a_rangefinder_tells_of_ground_that_rises():
    flight = slope()

    def above(k: int) -> float:
        east, north, up = flight.pose(k).translation
        return float(up - flight.place.height(np.array(east), np.array(north)))

    assert carried_over(flight, lambda k: None) > 2.0
    assert carried_over(flight, above) < 0.8


def test_a_rangefinder_that_meets_roofs_half_of_the_time_does_no_harm(plain):
    def over_a_town(k: int) -> float:
        return float(plain.pose(k).translation[2]) - (8.0 if k % 4 < 2 else 0.0)

    alone = carried_over(plain, lambda k: None)
    assert carried_over(plain, over_a_town) < alone + 0.3


@dataclass(frozen=True)
class Shape:
    """The slope's ground, by a terrain model of another datum."""

    place: SyntheticPlace

    def height(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        return self.place.height(np.asarray(east), np.asarray(north)) + 48.0


def test_a_terrain_models_shape_counts_and_not_its_datum():
    flight = slope()
    vo = odometry(max_sigma_m=10.0, ground=Shape(flight.place))
    begun(flight, vo, mapped=True)
    for k in range(1, 26):
        estimate = vo.step(flight.frame(k))
        assert estimate.usable, estimate.reason
    assert estimate.source is DepthSource.GROUND
    assert horizontal(estimate.world_from_camera, flight.pose(25)) < 0.8


def test_few_readings_are_no_ground():
    sounded = RangefinderGround()
    for k in range(4):
        sounded.add(k * STEP_NS, 5.0)
    assert sounded.at(4 * STEP_NS) is None
    sounded.add(4 * STEP_NS, 13.0)
    found = sounded.at(4 * STEP_NS)
    assert found.height_m == 5.0
    assert sounded.at(40 * STEP_NS) is None  # of long ago


def test_without_any_depth_there_is_nothing_to_carry_on_with(hills):
    with pytest.raises(OdometryError, match="call begin with a known pose"):
        odometry().step(hills.frame(1))
    with pytest.raises(OdometryError, match="neither the map nor a ground"):
        begun(hills, odometry(), mapped=False).step(hills.frame(1))


def test_a_covered_lens_is_told_and_a_short_one_survived(hills):
    vo = begun(hills, odometry(), mapped=True)
    assert vo.step(hills.frame(1), surface=hills.surface(1)).usable
    sigmas = []
    for k in range(2, 7):
        blind = vo.step(replace(hills.frame(k), fault=ImageFault.FLAT))
        assert blind.status is OdometryStatus.UNUSABLE_IMAGE
        assert not blind.usable
        assert "no structure" in blind.reason
        sigmas.append(blind.covariance[0, 0] ** 0.5)
        assert horizontal(blind.world_from_camera, hills.pose(k)) < 3 * sigmas[-1]
    assert sigmas == sorted(sigmas)
    again = vo.step(hills.frame(7), surface=hills.surface(7))
    assert again.usable, again.reason
    assert horizontal(again.world_from_camera, hills.pose(7)) < 0.3


def test_what_is_covered_for_long_is_lost_until_the_next_beginning(hills):
    vo = begun(hills, odometry(), mapped=True)
    for k in range(1, 8):
        blind = vo.step(replace(hills.frame(k), fault=ImageFault.FLAT))
        assert blind.status is OdometryStatus.UNUSABLE_IMAGE
    for k in range(8, 12):  # the picture is good again, and nobody knows where it is from
        lost = vo.step(hills.frame(k), surface=hills.surface(k))
        assert lost.status is OdometryStatus.LOST
        assert not lost.usable
    vo.begin(hills.frame(12), hills.pose(12), BEGUN, velocity=VELOCITY, surface=hills.surface(12))
    found = vo.step(hills.frame(13), surface=hills.surface(13))
    assert found.usable
    assert found.bridged_s == pytest.approx(STEP_NS * 1e-9)


def test_another_places_picture_is_refused(hills):
    elsewhere = Flight(SyntheticPlace.from_seed(99))
    vo = begun(hills, odometry(), mapped=True)
    for k in range(1, 6):
        wrong = vo.step(elsewhere.frame(k), surface=hills.surface(k))
        assert wrong.status is OdometryStatus.NOT_REGISTERED, k
        assert wrong.reason
    assert vo.step(hills.frame(6), surface=hills.surface(6)).usable


def test_a_constant_error_of_the_sensors_is_no_drift(plain):
    """The barometer reads 3 m too much and the gimbal is 1 degree off, from the beginning on."""

    def sensed(k):
        pose = plain.pose(k)
        turned = pose.rotation @ so3_exp(np.radians([1.0, -0.6, 0.5]))
        return combine(
            attitude_constraint(turned, np.radians(0.3), np.radians(4)),
            height_constraint(pose.translation[2] + 3.0, 0.2),
        )

    vo = begun(plain, odometry(FlatGround(0.0)), mapped=False, constraint=sensed(0))
    for k in range(1, 16):
        estimate = vo.step(plain.frame(k), constraint=sensed(k))
        assert estimate.usable, estimate.reason
    assert abs(estimate.world_from_camera.translation[2] - plain.pose(15).translation[2]) < 0.3
    assert plain.pose(15).distance_to(estimate.world_from_camera)[1] < 0.3


def test_the_barometer_holds_the_height(plain):
    """A beginning 4 m too high stays so without a barometer, and is mended with one."""
    high = Pose(plain.pose(0).rotation, plain.pose(0).translation + np.array([0.0, 0.0, 4.0]))
    unsure = BEGUN + np.diag([0, 0, 16.0, 0, 0, 0])
    heights = {}
    for name in ("free", "aided"):
        vo = odometry(FlatGround(0.0))
        vo.begin(plain.frame(0), high, unsure, velocity=VELOCITY)
        for k in range(1, 13):
            level = height_constraint(plain.pose(k).translation[2], 0.3)
            estimate = vo.step(plain.frame(k), constraint=level if name == "aided" else None)
        heights[name] = estimate.world_from_camera.translation[2] - plain.pose(12).translation[2]
    assert heights["free"] > 2.0
    assert abs(heights["aided"]) < 0.6


def test_sensors_corrected_by_the_start_do_not_make_the_start_more_certain(plain):
    """The constant error is measured with the start's own pose: it says nothing of that pose. A
    start 3 m off at a sigma of 1.5 m became 0.7 m sure in one frame (flight `gimbal-10deg`).
    """
    tilt = 1.5 / 100  # 1.5 m at 100 m above the ground
    lever = np.array([[0, 100.0, 0], [-100.0, 0, 0]])  # a tilt and a shift look alike
    unsure = BEGUN.copy()
    unsure[3:5, 3:5] = np.eye(2) * tilt**2
    unsure[:2, :2] += lever[:, :2] @ unsure[3:5, 3:5] @ lever[:, :2].T
    unsure[:2, 3:5] = lever[:, :2] * tilt**2
    unsure[3:5, :2] = unsure[:2, 3:5].T
    unsure[2, 2] = 4.0
    for known in (True, False):
        sensed = [
            combine(
                attitude_constraint(plain.pose(k).rotation, np.radians(0.4), np.radians(3)),
                height_constraint(plain.pose(k).translation[2], 0.5),
            )
            for k in range(4)
        ]
        vo = odometry(FlatGround(0.0))
        constraint = sensed[0] if known else None
        vo.begin(plain.frame(0), plain.pose(0), unsure, velocity=VELOCITY, constraint=constraint)
        for k in range(1, 4):
            estimate = vo.step(plain.frame(k), constraint=sensed[k])
        sigma = np.sqrt(estimate.covariance.diagonal())
        if known:
            assert (sigma[:3] > 0.95 * np.sqrt(unsure.diagonal()[:3])).all()
        else:  # never compared with the start, the sensors are evidence of their own
            assert (sigma[:3] < 0.7 * np.sqrt(unsure.diagonal()[:3])).all()


# --- Where a keyframe's anchors come from -------------------------------------------------------


POSE = camera_pose(np.array([5.0, -3.0, 80.0]), 60.0, 30.0)


class Slope:
    """Rises 0.1 m per metre to the east."""

    def height(self, east, north):
        return 0.1 * east


def test_map_points_keep_their_places_and_get_the_pictures_features(hills):
    features, surface = hills.frame(3).features, hills.surface(3)
    anchors, source = keyframe_anchors(features, CAMERA, hills.pose(3), surface, None, 5000)
    assert source is DepthSource.MAP
    assert len(anchors.points_world) > 0.8 * len(surface)
    assert {tuple(p) for p in anchors.points_world} <= {tuple(p) for p in surface}
    pixels, inside = CAMERA.project(hills.pose(3).inverse.apply(anchors.points_world))
    assert inside.all()
    np.testing.assert_allclose(pixels, anchors.pixels, atol=1e-4)
    level = features.levels[-1]
    uv = anchors.pixels.astype(np.float64) / level.stride - 0.5
    np.testing.assert_allclose(
        anchors.features[-1], sample_features(level.features, uv[:, 0], uv[:, 1]), atol=1e-5
    )


def test_the_ground_fills_what_the_map_leaves(hills):
    """The map ends in the middle of the picture: each half gets its own depth."""
    surface, pose = hills.surface(3), hills.pose(3)
    pixels, _ = CAMERA.project(pose.inverse.apply(surface))
    left = surface[pixels[:, 0] < CAMERA.width / 2]
    ground = FlatGround(-50.0)  # far below the map's surfaces, to tell them apart
    anchors, source = keyframe_anchors(hills.frame(3).features, CAMERA, pose, left, ground, 600)
    by_map = anchors.points_world[:, 2] > -20
    assert (anchors.pixels[by_map, 0] < CAMERA.width / 2 + 2).all()
    right = anchors.pixels[:, 0] > CAMERA.width / 2 + 12
    assert right.sum() > 150
    assert not by_map[right].any()
    assert source is DepthSource.MAP
    few, source = keyframe_anchors(hills.frame(3).features, CAMERA, pose, left[::10], ground, 600)
    assert source is DepthSource.GROUND
    assert len(few.points_world) > 300


@pytest.mark.parametrize("ground", [FlatGround(4.0), Slope()])
def test_rays_meet_the_ground_where_it_is(ground):
    pixels = np.array([[10.0, 20.0], [80.0, 60.0], [150.0, 110.0]])
    points, met = ground_points(ground, POSE, CAMERA, pixels)
    assert met.all()
    np.testing.assert_allclose(points[:, 2], ground.height(*points.T[:2]), atol=0.01)
    np.testing.assert_allclose(CAMERA.project(POSE.inverse.apply(points))[0], pixels, atol=1e-6)


def test_features_on_the_gpu_are_refused(hills):
    level = hills.frame(0).features.levels[0]
    on_device = replace(level, features=DeviceArray(64, level.features.shape, np.dtype("f4")))
    features = replace(hills.frame(0).features, levels=(on_device,))
    with pytest.raises(DeviceArrayError, match="extracted to the host"):
        keyframe_anchors(features, CAMERA, POSE, None, FlatGround(0.0), 500)


def test_the_ground_is_below_the_roofs():
    rng = np.random.default_rng(0)
    heights = np.r_[rng.normal(12.0, 0.3, 600), rng.uniform(16.0, 30.0, 400)]
    points = np.column_stack([rng.uniform(0, 100, (1000, 2)), heights])
    assert FlatGround.under(points).height_m == pytest.approx(12.0, abs=0.4)


def test_an_uncertain_place_above_a_slope_is_at_an_uncertain_height_above_the_ground():
    """10 m of sigma across 20 % of slope are 2 m of height; along the slope's contours none."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-50, 50, (500, 2)), np.zeros(500)])
    points[:, 2] = 0.2 * points[:, 0] + rng.normal(0, 0.5, 500)
    place = np.array([0.0, 0.0, 80.0])
    for variance, expected in (((100.0, 0.0, 1.0), 5**0.5), ((0.0, 100.0, 1.0), 1.0)):
        above, sigma = height_above_ground(points, np.diag(variance), place)
        assert above == pytest.approx(80.0, abs=1.0)
        assert sigma == pytest.approx(expected, rel=0.05)


# --- Which pictures are refused, and that poor but usable ones are not --------------------------


SIZE = (240, 320, 3)


def ground_picture(seed: int = 0) -> np.ndarray:
    """Texture on all scales, as the ground has it, with a camera's noise."""
    rng = np.random.default_rng(seed)
    total = np.zeros(SIZE[:2], np.float32)
    for cells in (4, 10, 25, 60, 120):
        field = rng.standard_normal((cells * 3 // 4, cells)).astype(np.float32)
        total += cv2.resize(field, (SIZE[1], SIZE[0]), interpolation=cv2.INTER_CUBIC)
    grey = 110 + 18 * total
    noisy = grey[..., None] + rng.normal(0, 2, SIZE)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def in_fog(image: np.ndarray, visible: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    hazy = image * visible + 205 * (1 - visible) + rng.normal(0, 1.5, image.shape)
    return np.clip(hazy, 0, 255).astype(np.uint8)


def covered(grey: float) -> np.ndarray:
    """A hand over the lens: a smooth gradient with noise."""
    rng = np.random.default_rng(2)
    ramp = grey + 0.1 * np.arange(SIZE[1])[None, :, None]
    return np.clip(ramp + rng.normal(0, 3, SIZE), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("picture", "fault"),
    [
        (covered(3.0) // 12, ImageFault.BLACK),
        (covered(40.0), ImageFault.FLAT),
        (in_fog(ground_picture(), 0.01), ImageFault.FLAT),
        (np.full(SIZE, 255, np.uint8), ImageFault.SATURATED),
        (cv2.GaussianBlur(ground_picture(), (0, 0), 6), ImageFault.BLURRED),
        (cv2.blur(ground_picture(), (41, 1)), ImageFault.BLURRED),
        (cv2.blur(ground_picture(), (1, 41)), ImageFault.BLURRED),
    ],
)
def test_a_picture_without_use_is_refused_by_its_name(picture, fault):
    assert find_fault(picture) is fault


@pytest.mark.parametrize(
    "picture",
    [
        ground_picture(),
        in_fog(ground_picture(), 0.25),
        cv2.GaussianBlur(ground_picture(), (0, 0), 1.0),
        cv2.blur(ground_picture(), (5, 1)),
        (ground_picture() * 0.15).astype(np.uint8),
        np.minimum(ground_picture().astype(int) + 90, 255).astype(np.uint8),
    ],
    ids=["clear", "fog", "defocus", "motion", "dusk", "bright"],
)
def test_a_poor_picture_is_not_refused(picture):
    assert find_fault(picture) is None


def test_a_repeated_picture_is_a_frozen_stream():
    picture = ground_picture()
    assert find_fault(picture, picture.copy()) is ImageFault.FROZEN
    assert find_fault(picture, ground_picture(1)) is None


@pytest.mark.parametrize(("flat", "fault"), [(0.5, None), (0.75, None), (0.85, ImageFault.FLAT)])
def test_a_quarter_of_a_picture_is_enough(flat, fault):
    picture = ground_picture()
    picture[: round(flat * len(picture))] = 128
    assert find_fault(picture) is fault


# --- The keyframe's pose from how the picture moved over the map's shape ------------------------


FIRST, SECOND = 0, 6  # 24 m apart
NOISE = 0.02


@pytest.fixture(scope="module")
def mountains() -> Flight:
    return Flight(SyntheticPlace.from_seed(7, relief_m=25.0))


def prior(flight: Flight, tilt_deg: float, shift_m: float) -> tuple[Array, Array]:
    """Covariance (6, 6) and its root of a pose that keeps the ground in the picture's middle."""
    pose = flight.pose(FIRST)
    arm = pose.rotation[:, 2] * 100.0 / -pose.rotation[2, 2]
    root = np.zeros((6, 6))
    root[:3, :3] = shift_m * np.eye(3)
    root[3:, 3:] = np.radians(tilt_deg) * np.eye(3)
    root[:3, 3:] = hat(arm) @ root[3:, 3:]
    return root @ root.T, root


def aligned(flight: Flight, step: Array, covariance: Array) -> ParallaxAlignment | None:
    first, second = flight.pose(FIRST), flight.pose(SECOND)
    turn = so3_exp(step[3:])
    moved = Pose(turn @ first.rotation, first.translation + step[:3])
    arm = turn @ (second.translation - first.translation)
    after = Pose(turn @ second.rotation, moved.translation + arm)
    views = (
        ParallaxView(flight.frame(FIRST).features, moved, CAMERA),
        ParallaxView(flight.frame(SECOND).features, after, CAMERA),
    )
    return align(NumbaBackend(1), *views, flight.surface(FIRST), covariance, NOISE)


def off(pose: Pose, truth: Pose) -> Array:
    turn = np.degrees(so3_log(pose.rotation @ truth.rotation.T))
    return np.concatenate([pose.translation - truth.translation, turn])


def test_a_keyframe_that_is_off_is_brought_to_the_maps_shape(mountains: Flight) -> None:
    covariance, root = prior(mountains, 1.0, 0.5)
    before, after, distances, narrower = [], [], [], []
    for seed in range(4):
        step = root @ np.random.default_rng(seed).normal(0, 1, 6)
        found = aligned(mountains, step, covariance)
        error = off(found.first, mountains.pose(FIRST))
        before.append(np.degrees(step[3:5]))
        after.append(error[3:5].copy())
        error[3:] = np.radians(error[3:])
        distances.append(error @ np.linalg.solve(found.covariance, error) / 6)
        narrower.append(np.linalg.det(found.covariance) / np.linalg.det(covariance))
        # The second picture's pose goes along.
        second = off(found.second, mountains.pose(SECOND))
        np.testing.assert_allclose(second[3:5], after[-1], atol=0.5)
    assert np.linalg.norm(after) < 0.85 * np.linalg.norm(before)  # small pictures, no detail
    assert np.mean(distances) < 3.0
    # Over the draws: this prior's axes are equally long, so which of them the cost is sampled along
    # is the linear algebra library's choice, and one draw's figure differs between processors.
    assert np.exp(np.mean(np.log(narrower))) < 0.1
    assert max(narrower) < 0.5


def test_a_keyframe_that_is_right_stays_there(mountains: Flight) -> None:
    covariance, _ = prior(mountains, 0.2, 0.1)
    found = aligned(mountains, np.zeros(6), covariance)
    error = off(found.first, mountains.pose(FIRST))
    error[3:] = np.radians(error[3:])
    assert error @ np.linalg.solve(covariance, error) < 4.0


def test_nothing_is_told_where_nothing_is_seen(mountains: Flight) -> None:
    covariance, _ = prior(mountains, 0.2, 0.1)
    elsewhere = mountains.surface(FIRST) + np.array([5000.0, 0.0, 0.0])
    view = ParallaxView(mountains.frame(FIRST).features, mountains.pose(FIRST), CAMERA)
    assert align(NumbaBackend(1), view, view, elsewhere, covariance, NOISE) is None
