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
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.odometry.config import OdometryConfig
from localizer.odometry.keyframe import DepthSource
from localizer.registration.jngo import JNGO
from localizer.registration.priors import PoseConstraint
from localizer.tracking.dead_reckoning import DeadReckoning
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.opening import open_localizer
from localizer.tracking.pipeline import Localizer
from localizer.types import Frame, PoseEstimate, PosePrior, TrackingState
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
