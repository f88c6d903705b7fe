"""Carrying a pose on: how far off it is, what it says of itself, and when it stops."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from localizer.errors import OdometryError
from localizer.geometry.pose import Pose, so3_exp
from localizer.odometry.config import OdometryConfig
from localizer.odometry.estimate import OdometryStatus
from localizer.odometry.ground import FlatGround, GroundUncertainty, RangefinderGround, TerrainModel
from localizer.odometry.keyframe import DepthSource
from localizer.odometry.odometry import VisualOdometry, odometry_optimizer
from localizer.odometry.usability import ImageFault, Usability
from localizer.registration.jngo import JNGO
from localizer.registration.priors import (
    PoseConstraint,
    attitude_constraint,
    combine,
    height_constraint,
)
from tests.localizer.odometry.conftest import BEGUN, CAMERA, STEP_NS, VELOCITY, Flight
from tests.localizer.registration.conftest import SyntheticPlace

COVERED = Usability(ImageFault.FLAT, 0.0, 0.0, 0.0, 0.0)


def odometry(
    ground: TerrainModel | None = None,
    uncertainty: GroundUncertainty | None = None,
    **changes: object,
) -> VisualOdometry:
    optimizer = odometry_optimizer(JNGO(threads=1))
    config = OdometryConfig(**{"anchors": 600, **changes})
    return VisualOdometry(CAMERA, optimizer, config, ground, uncertainty=uncertainty)


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
    assert found is not None
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
        blind = vo.step(replace(hills.frame(k), usability=COVERED))
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
        blind = vo.step(replace(hills.frame(k), usability=COVERED))
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
