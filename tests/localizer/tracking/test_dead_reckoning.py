"""A flight over the map's edge on real features: carried on by odometry, and found again."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from companion.recorded.sequence import load_sequence
from localizer.config import LocalizerConfig
from localizer.errors import OdometryError
from localizer.evaluation.sequences import Sequence
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.integrity.acceptance import IntegrityConfig
from localizer.map.cache.cache import TileCache
from localizer.odometry.config import OdometryConfig
from localizer.odometry.keyframe import DepthSource
from localizer.registration.jngo import JNGO
from localizer.registration.priors import PoseConstraint
from localizer.registration.result import Registration
from localizer.tracking.attitude_bias import AttitudePrior
from localizer.tracking.dead_reckoning import DeadReckoning
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.opening import open_localizer
from localizer.tracking.pipeline import Localizer
from localizer.tracking.rejoining import Rejoining
from localizer.tracking.sensor_fusion import SensorFusion
from localizer.types import Frame, PoseEstimate, PosePrior, RegistrationStatus, TrackingState
from sitl.demo.assets import FlightAssets

SEEN, EDGE = 8, 20  # frames with the map, and without it afterwards


@pytest.fixture(scope="module")
def sequence(small_assets: FlightAssets, small_sequence: Path) -> Sequence:
    return load_sequence(small_sequence, TileCache.open(small_assets.map_cache).frame)


def without_map(localizer: Localizer, frame: Frame) -> PoseEstimate:
    return localizer.localize(frame, localizer.extract_query(frame), None)


def error_m(estimate: PoseEstimate, truth: Pose) -> float:
    return float(np.linalg.norm(estimate.world_from_camera.translation - truth.translation))


@pytest.mark.parametrize("longest_m", [15.0, 0.01])
def test_the_maps_edge_is_bridged_and_the_map_found_again(small_assets, sequence, longest_m):
    """Where there is no map to be found again, also beyond the largest sigma."""
    config = LocalizerConfig(width=256, odometry=OdometryConfig(longest_sigma_m=longest_m))
    with open_localizer(small_assets.map_cache, sequence.frame(0).camera, config) as localizer:
        first = sequence.frame(0)
        localizer.set_prior(PosePrior(sequence.truth[0], np.eye(6) * 0.01, first.exposure_time_ns))
        for k in range(SEEN):
            estimate = localizer.track(sequence.frame(k))
        assert estimate.state is TrackingState.TRACKING
        sigmas = []
        for k in range(SEEN, EDGE):
            estimate = without_map(localizer, sequence.frame(k))
            sigmas.append(float(np.sqrt(estimate.covariance[0, 0])))
        assert estimate.state is TrackingState.BRIDGING
        assert estimate.accepted
        way_m = np.linalg.norm(
            sequence.truth[EDGE - 1].translation - sequence.truth[SEEN].translation
        )
        assert error_m(estimate, sequence.truth[EDGE - 1]) < 0.5 + 0.03 * way_m
        assert sigmas[-1] > sigmas[3]  # it says so itself
        for k in range(EDGE, EDGE + 3):
            estimate = localizer.track(sequence.frame(k))
        assert estimate.state is TrackingState.TRACKING
        assert error_m(estimate, sequence.truth[EDGE + 2]) < 0.5


class _HeardOdometry:
    """What the odometry is told of the camera's height."""

    told: ClassVar[list[float]] = []

    def __init__(self, *_: Any, **__: Any) -> None:
        self.ready = True

    def begin(self, *_: Any, constraint: PoseConstraint, **__: Any) -> None:
        self.told.append(float(constraint.world_from_camera.translation[2]))

    def step(self, *_: Any, constraint: PoseConstraint, **__: Any) -> Any:
        self.told.append(float(constraint.world_from_camera.translation[2]))
        raise OdometryError("heard")

    def forget(self) -> None:
        pass


def test_a_height_far_from_the_origin_is_told_in_the_worlds_axes(monkeypatch):
    """An aircraft that keeps its height 10 km from the map's origin was told to climb against the
    plane: 0.8 m in half a kilometre.
    """
    monkeypatch.setattr("localizer.tracking.dead_reckoning.VisualOdometry", _HeardOdometry)
    _HeardOdometry.told.clear()
    frame_of_map = LocalFrame(Geodetic(47.0, 8.0, 500.0))
    places = [frame_of_map.enu_from_geodetic(47.0, lon, 600.0) for lon in (8.13, 8.137)]
    camera = Camera.from_fov(64, 48, 60)
    sensors = AuxiliarySensors(height_at=lambda _: 100.0)
    dead_reckoning = DeadReckoning(camera, JNGO(threads=1), LocalizerConfig().odometry, 1, sensors)
    begun: Any = SimpleNamespace(
        camera=camera, exposure_time_ns=0, covariance=np.eye(6),
        world_from_camera=Pose(np.eye(3), places[0]),
    )  # fmt: skip
    nothing: Any = SimpleNamespace(points_world=None)
    dead_reckoning.begin(begun, nothing, nothing, np.zeros(3))
    prior = PosePrior(Pose(np.eye(3), places[1]), np.eye(6), 1)
    image = np.zeros((48, 64, 3), np.uint8)
    dead_reckoning.propagate(Frame(image, 1, camera, 1), nothing, prior, None)
    assert _HeardOdometry.told == pytest.approx([place[2] for place in places], abs=0.05)


def test_a_covered_lens_ends_the_bridge(small_assets: FlightAssets, sequence: Sequence) -> None:
    config = LocalizerConfig(width=256)
    with open_localizer(small_assets.map_cache, sequence.frame(0).camera, config) as localizer:
        first = sequence.frame(0)
        localizer.set_prior(PosePrior(sequence.truth[0], np.eye(6) * 0.01, first.exposure_time_ns))
        for k in range(SEEN):
            localizer.track(sequence.frame(k))
        for k in range(SEEN, EDGE + 8):
            frame = sequence.frame(k)
            black = Frame(
                np.full_like(frame.image, 8), frame.exposure_time_ns, frame.camera, frame.sequence
            )
            estimate = without_map(localizer, black)
            assert not estimate.accepted
        assert estimate.state is TrackingState.LOST


def test_a_beginning_without_depth_ends_the_bridge_and_not_the_judging(
    small_assets: FlightAssets, sequence: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each frame raised: none was judged, the state stayed "tracking", and nobody searched."""
    config = LocalizerConfig(width=256)
    with open_localizer(small_assets.map_cache, sequence.frame(0).camera, config) as localizer:
        first = sequence.frame(0)
        localizer.set_prior(PosePrior(sequence.truth[0], np.eye(6) * 0.01, first.exposure_time_ns))
        for k in range(SEEN):
            localizer.track(sequence.frame(k))
        nothing = (SimpleNamespace(points_world=()), DepthSource.GROUND)
        monkeypatch.setattr("localizer.odometry.odometry.keyframe_anchors", lambda *_: nothing)
        for k in range(SEEN, EDGE):
            estimate = without_map(localizer, sequence.frame(k))
            assert not estimate.accepted
        assert estimate.state is TrackingState.LOST
        assert localizer.tracker.track_status.wants_prior


# --- rejoining ----------------------------------------------------------------------------------


CONFIG = IntegrityConfig()
COVARIANCE = np.diag([0.15**2] * 3 + [0.002**2] * 3)
ASIDE = np.array([-2.6, 1.4, 0.3])  # of the carried pose, as after a slew that was not modelled


def _run(
    registrations: list[np.ndarray], carried: list[np.ndarray], rotation: np.ndarray | None = None
) -> list[bool]:
    said, run = [], Rejoining()
    for k, (answer, place) in enumerate(zip(registrations, carried, strict=True)):
        run = run.with_registration(
            Pose(np.eye(3), answer), COVARIANCE, k * 100_000_000, Pose(np.eye(3), place), rotation,
            CONFIG,
        )  # fmt: skip
        said.append(run.confirmed)
    return said


def _way(speed: float, count: int, noise_m: float = 0.1) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [
        np.array([0.1 * speed * k, 0.0, 100.0]) + rng.normal(0, noise_m, 3) for k in range(count)
    ]


def test_answers_that_move_as_the_odometry_does_win_within_a_second():
    true = _way(10.0, 14)
    said = _run(true, [p + ASIDE for p in _way(10.0, 14, 0.02)])
    assert not any(said[:7])
    assert said[10:] == [True] * 4


def test_a_match_that_moves_otherwise_never_wins():
    carried = _way(10.0, 40, 0.02)
    sliding = [p + ASIDE + np.array([0.0, -0.35 * k, 0.0]) for k, p in enumerate(carried)]
    scattered = [p + np.random.default_rng(k).normal(0, 3.0, 3) for k, p in enumerate(carried)]
    stuck = [carried[0] + ASIDE] * 40
    for registrations in (sliding, scattered, stuck):
        assert not any(_run(registrations, carried))


@pytest.mark.parametrize(("rotation", "wins"), [(None, False), (np.eye(3), True)])
def test_a_hover_shows_nothing_new_without_the_autopilots_attitude(rotation, wins):
    registrations = _way(0.0, 40, 0.05)
    assert any(_run(registrations, [p + ASIDE for p in registrations], rotation)) is wins


def test_an_attitude_that_the_autopilot_refutes_never_wins():
    registrations = _way(10.0, 20)
    tilted = np.array([[1.0, 0, 0], [0, 0.94, -0.34], [0, 0.34, 0.94]])
    assert not any(_run(registrations, [p + ASIDE for p in registrations], tilted))


# --- What attitude and height do to a registered pose, and when they are left out ---------------


DOWN: Array = np.diag([1.0, -1.0, -1.0])
HEIGHT_M = 100.0
ATTITUDE = AttitudePrior(tilt_sigma_deg=0.4, alignment_sigma_deg=0.3)  # 0.5 together


def registered(tilt_sigma_deg: float, height_sigma_m: float) -> Registration:
    """Without patches, so that the covariance stays what is given here."""
    tilt = np.radians(tilt_sigma_deg)
    covariance = np.diag([1.0, 1.0, height_sigma_m**2, tilt**2, tilt**2, 1e-4])
    pose = Pose(DOWN, np.array([0.0, 0.0, HEIGHT_M]))
    return Registration(pose, covariance, 0.1, 0.9, 0.6, RegistrationStatus.OK, 1)


def fusion(tilt_off_deg: float, height_off_m: float) -> SensorFusion:
    rotation = so3_exp([np.radians(tilt_off_deg), 0.0, 0.0]) @ DOWN
    sensors = AuxiliarySensors(
        rotation_at=lambda _: rotation, height_at=lambda _: HEIGHT_M + height_off_m
    )
    return SensorFusion(ATTITUDE, 3.0, sensors)


def tilt_deg(pose: Pose) -> float:
    return float(np.degrees(np.arccos(np.clip((pose.rotation @ DOWN.T)[2, 2], -1, 1))))


def test_what_the_image_does_not_know_is_taken_from_the_sensors():
    found = fusion(3.0, 8.0).fuse(registered(4.0, 8.0), 0)
    assert not found.contradicted
    assert tilt_deg(found.registration.world_from_camera) == pytest.approx(3.0, abs=0.1)
    # Height: 8 m become the 3 m of the sensor, so the pose moves by 1 - 9 / 64 of the way.
    rise = found.registration.world_from_camera.translation[2] - HEIGHT_M
    assert rise == pytest.approx(8.0 * (1 - 9 / 64), abs=0.01)
    sigma_m = np.sqrt(found.registration.covariance[2, 2])
    assert sigma_m == pytest.approx(3.0, abs=0.01)


def test_what_the_image_knows_stays():
    """A gimbal 0.6 degrees off took poses along that the image knew to 0.3 degrees."""
    before = registered(0.3, 0.1)
    found = fusion(0.6, 3.0).fuse(before, 0)
    assert not found.contradicted
    np.testing.assert_allclose(
        found.registration.world_from_camera.matrix, before.world_from_camera.matrix
    )


@pytest.mark.parametrize(("tilt_off", "height_off"), [(3.0, 0.0), (0.0, 30.0)])
def test_a_sensor_that_contradicts_is_left_out_and_reported(tilt_off, height_off):
    before = registered(0.1, 0.1)
    found = fusion(tilt_off, height_off).fuse(before, 0)
    assert found.contradicted
    after = found.registration.world_from_camera
    assert tilt_deg(after) < 0.01
    assert after.translation[2] == pytest.approx(HEIGHT_M, abs=0.01)
