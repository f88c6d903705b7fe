"""A flight over the map's edge on real features: carried on by odometry, and found again."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.evaluation.sequences import Sequence, load_sequence
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.odometry.keyframe import DepthSource
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


def test_the_maps_edge_is_bridged_and_the_map_found_again(
    small_assets: FlightAssets, sequence: Sequence
) -> None:
    config = LocalizerConfig(width=256)
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
        assert localizer.tracker.standing.wants_prior
