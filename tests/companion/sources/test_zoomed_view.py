"""What a lens that zooms sees, the map is rendered for: it is matched as it is without a zoom."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from companion.sources.zoom import with_focal_factor
from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera, with_field_of_view
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import Appearance
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.opening import open_localizer
from localizer.tracking.pipeline import Localizer
from localizer.types import Frame, PoseEstimate, PosePrior, TrackingState
from sitl.camera.true_motion import PoseTrack
from sitl.camera.world_camera import CameraOptions, WorldCamera
from sitl.demo.assets import FlightAssets

LENS = Camera(320, 240, 251.0, 251.0, 160.0, 120.0, (-0.09, 0.02, 0.0, 0.0, 0.0))
PERIOD_NS, COUNT, HEIGHT_M = 125_000_000, 7, 80.0
CONFIG = LocalizerConfig(renderer="numba", device="cpu")


class Flight:
    """Flies north at 8 m/s and looks 10 degrees ahead of straight down."""

    def __init__(self, assets: FlightAssets, streamer: TileStreamer) -> None:
        self._up_m = HEIGHT_M + float(assets.world.ground_height(0.0, 0.0))
        times = range(0, (COUNT + 2) * PERIOD_NS, 20_000_000)
        self._track = PoseTrack([(t, self.pose(t)) for t in times])
        origin = TileCache.open(assets.map_cache).frame.ecef_from_enu
        live = TileCache.open(assets.live_cache).frame.ecef_from_enu
        self._options = CameraOptions(scene_from_world=live.inverse @ origin)
        self._renderer = NumbaRenderer(streamer)

    def pose(self, time_ns: int) -> Pose:
        """Where the camera is."""
        down = so3_exp([np.radians(10.0), 0.0, 0.0]) @ np.diag([1.0, -1.0, -1.0])
        return Pose(down, np.array([0.0, 8e-9 * time_ns - 40.0, self._up_m]))

    def frame(self, k: int, factor: float) -> Frame:
        """The k-th picture, of a lens so many times longer."""
        lens = with_focal_factor(LENS, factor)
        camera = WorldCamera(self._renderer, lens, Appearance(), self._options)
        seen = camera.expose(k * PERIOD_NS, self._track)
        assert seen is not None
        return Frame(seen.image, seen.time_ns, lens, k)

    def prior(self) -> PosePrior:
        """At the first picture."""
        begun = PosePrior(self.pose(PERIOD_NS), np.eye(6) * 0.01, PERIOD_NS)
        return replace(begun, velocity=np.array([0.0, 8.0, 0.0]))

    def off_m(self, estimate: PoseEstimate) -> float:
        """How far it is beside the truth; inf where it is not given out."""
        true = self.pose(estimate.exposure_time_ns)
        given = estimate.accepted
        return estimate.world_from_camera.distance_to(true)[0] if given else float("inf")


@pytest.fixture(scope="module")
def flight(small_assets: FlightAssets) -> Iterator[Flight]:
    streamer = TileStreamer(TileCache.open(small_assets.live_cache))
    yield Flight(small_assets, streamer)
    streamer.close()


@contextmanager
def localizer_of(flight: Flight, assets: FlightAssets) -> Iterator[Localizer]:
    sensors = AuxiliarySensors(lambda time_ns: flight.pose(time_ns).rotation)
    with open_localizer(assets.map_cache, LENS, CONFIG, sensors) as localizer:
        localizer.set_prior(flight.prior())
        yield localizer


def flown(
    flight: Flight, localizer: Localizer, factor: Callable[[int], float], seen: int = COUNT
) -> list[PoseEstimate]:
    """As the engine does: the reference for a picture is rendered before the picture is there.

    seen: so many pictures have one; the odometry carries the pose on over the others.
    """
    estimates, bundle = [], None
    for k in range(1, COUNT + 1):
        prior = localizer.predict(k * PERIOD_NS)
        assert prior is not None
        bundle = localizer.reference_for(prior, bundle, wait=True)
        frame, anchors = flight.frame(k, factor(k)), bundle.anchors if k <= seen else None
        estimates.append(localizer.localize(frame, localizer.extract_query(frame), anchors))
    return estimates


@pytest.mark.parametrize("factor", [lambda _: 1.4, lambda k: 0.75 + 0.25 * k])
def test_it_is_matched_at_any_zoom(flight, small_assets, factor):
    with localizer_of(flight, small_assets) as localizer:
        estimates = flown(flight, localizer, factor)
    # The first reference is of the lens before it zoomed: it shows too little for some.
    assert sum(not e.accepted for e in estimates) <= 1
    assert max(flight.off_m(e) for e in estimates if e.accepted) < 0.15


def test_the_odometry_carries_on_while_the_lens_zooms(flight, small_assets):
    with localizer_of(flight, small_assets) as localizer:
        estimates = flown(flight, localizer, lambda k: 1.0 + 0.05 * max(k - 3, 0), seen=3)
    bridged = [e for e in estimates if e.state is TrackingState.BRIDGING]
    assert len(bridged) >= COUNT - 5  # two that failed, before the odometry is asked
    assert max(flight.off_m(e) for e in bridged) < 0.3


def test_a_lens_that_does_not_zoom_has_one_pinhole_for_all(flight, small_assets):
    with localizer_of(flight, small_assets) as localizer:
        pinhole = localizer.camera
        for camera in (LENS, LENS.resized(640, 480), LENS.resized(160, 121)):
            assert with_field_of_view(pinhole, camera) is pinhole
        localizer.extract_query(flight.frame(1, 1.0))
        assert localizer.camera is pinhole
        localizer.extract_query(flight.frame(2, 1.4))
        assert localizer.camera.fx == pytest.approx(1.4 * pinhole.fx)
        localizer.extract_query(flight.frame(3, 1.0))
        assert localizer.camera is pinhole
