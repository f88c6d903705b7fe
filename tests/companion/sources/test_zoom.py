"""A camera that zooms: the focal length of its report, and no fix where there is none."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from companion.sources.zoom import FocalCorrection, ZoomedFrames, ZoomTable, with_focal_factor
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
from localizer.types import FocalFit, Frame, PoseEstimate, PosePrior, TrackingState
from sitl.camera.true_motion import PoseTrack
from sitl.camera.world_camera import CameraOptions, WorldCamera
from sitl.demo.assets import FlightAssets
from tests.companion.estimates import estimated

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
TABLE = ZoomTable(points=((0.0, 1.0), (50.0, 2.0), (100.0, 4.5)))
SECOND = 10**9
PERIOD_NS = 125_000_000


def frame(time_ns: int) -> Frame:
    return Frame(np.zeros((48, 64, 3), np.uint8), time_ns, CAMERA, 0)


class Zoom:
    """A camera that says a level, or none; what was told."""

    def __init__(self, level: float | None) -> None:
        self.level, self.told = level, list[str]()
        self.frames = ZoomedFrames(TABLE, lambda _time_ns, _hold_s: self.level, self.told.append)


def test_between_its_points_the_table_rises_and_beyond_them_it_says_nothing() -> None:
    factors = [TABLE.factor(level) for level in np.linspace(0.0, 100.0, 41)]
    assert factors[0] == 1.0
    assert factors[-1] == pytest.approx(4.5)
    assert np.diff([f for f in factors if f is not None]).min() > 0.0
    assert TABLE.factor(25.0) == pytest.approx(np.sqrt(2.0))
    short = ZoomTable(points=((10.0, 1.0), (60.0, 2.0)))
    assert short.factor(9.0) is None
    assert short.factor(61.0) is None


@pytest.mark.parametrize(
    "points",
    [
        ((0.0, 1.0),),
        ((0.0, 2.0), (50.0, 1.0)),
        ((50.0, 1.0), (50.0, 2.0)),
        ((0.0, 0.0), (50.0, 1.0)),
        ((0.0, 1.0), (120.0, 2.0)),
        ((0.0, 1.0), (50.0, float("nan"))),
    ],
)
def test_a_table_that_no_lens_has_is_refused(points: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ValidationError):
        ZoomTable(points=points)


def test_a_frame_has_the_camera_of_its_zoom() -> None:
    seen = Zoom(50.0).frames(frame(SECOND))
    assert (seen.camera.fx, seen.camera.fy) == (100.0, 100.0)
    assert (seen.camera.cx, seen.camera.width) == (32.0, 64)


def test_a_report_that_trembles_is_no_other_camera() -> None:
    """Each other camera costs new undistortion maps."""
    zoom = Zoom(50.0)
    first = zoom.frames(frame(SECOND))
    zoom.level = 50.03  # 0.04 % of focal length
    second = zoom.frames(frame(2 * SECOND))
    zoom.level = 50.2
    third = zoom.frames(frame(3 * SECOND))
    assert first.camera == second.camera != third.camera


@pytest.mark.parametrize("level", [None, 101.0])
def test_a_zoom_that_is_not_known_gives_no_frame_and_is_told(level: float | None) -> None:
    """Once in ten seconds, and again when it comes again."""
    zoom = Zoom(level)
    assert [zoom.frames(frame(second * SECOND)) for second in range(25)] == [None] * 25
    assert len(zoom.told) == 3
    zoom.level = 0.0
    assert zoom.frames(frame(26 * SECOND)).exposure_time_ns == 26 * SECOND
    zoom.level = level
    assert zoom.frames(frame(27 * SECOND)) is None
    assert len(zoom.told) == 4


# --- The table is corrected by what pictures show: slowly, and within its bound ------------------


BELIEVED = ((0.0, 1.0), (100.0, 2.0))


def fitted(time_ns: int, factor: float) -> PoseEstimate:
    return estimated(time_ns=time_ns, quality=0.8, camera=CAMERA, focal=FocalFit(factor, 0.003))


class Lens:
    """Says a level; its pictures fit a focal length that is `truth` times the table's."""

    def __init__(self, refine: float, truth: float) -> None:
        table = ZoomTable(points=BELIEVED, refine=refine)
        self.level, self.truth, self.time_ns = 0.0, truth, 0
        self.table = table
        self.zoomed = ZoomedFrames(table, lambda _time_ns, _hold_s: self.level, pytest.fail)

    def take(self) -> float:
        """The factor of the next picture."""
        self.time_ns += PERIOD_NS
        return self.zoomed(frame(self.time_ns)).camera.fx / CAMERA.fx

    def see(self, pictures: int) -> float:
        """The factor over the table's, in the last of so many more."""
        by_table = self.table.factor(self.level) or math.nan
        for _ in range(pictures):
            given = self.take()
            self.zoomed.learn(fitted(self.time_ns, by_table * self.truth / given))
        return given / by_table


def test_it_is_slow_and_never_beyond_its_bound() -> None:
    lens = Lens(0.01, 1.008)
    assert 1.0 < lens.see(2) < 1.004
    assert lens.see(60) == pytest.approx(1.008, abs=0.0015)
    beyond = Lens(0.005, 1.03)
    factors = [beyond.see(1) for _ in range(200)]
    assert max(factors) <= 1.005 + 1e-9
    assert Lens(0.0, 1.008).see(60) == 1.0  # not asked for


def test_another_zoom_has_another_error() -> None:
    """What was learned is kept until pictures say otherwise, and is as unsure as at first."""
    lens = Lens(0.01, 1.008)
    lens.see(60)
    sure, anew = FocalCorrection(0.01), FocalCorrection(0.01)
    for _ in range(60):
        sure.learn(math.log(1.008), 0.003)
    lens.level, lens.truth = 50.0, 0.996
    assert lens.see(60) == pytest.approx(0.996, abs=0.0015)
    sure.zoom_changed(0.4)
    before = sure.value
    sure.learn(before + 0.01, 0.003)
    anew.learn(0.01, 0.003)
    assert sure.value - before == pytest.approx(anew.value, rel=1e-6) or sure.value > 0.0099


def test_pictures_of_another_zoom_say_nothing() -> None:
    lens = Lens(0.01, 1.008)
    lens.see(1)
    taken_ns = lens.time_ns
    lens.level = 30.0
    before = lens.take()
    for _ in range(50):
        lens.zoomed.learn(fitted(taken_ns, 1.01))
        lens.zoomed.learn(fitted(12345, 1.01))  # of no picture that was given
    assert lens.take() == pytest.approx(before, rel=1e-9)


# --- zoomed view --------------------------------------------------------------------------------


LENS = Camera(320, 240, 251.0, 251.0, 160.0, 120.0, (-0.09, 0.02, 0.0, 0.0, 0.0))
COUNT, HEIGHT_M = 7, 80.0
CONFIG = LocalizerConfig(renderer="numba", device="cpu")


class Flight:
    """Flies north at 8 m/s and looks so much ahead of straight down; steps: between its pictures,
    periods.
    """

    def __init__(
        self, assets: FlightAssets, streamer: TileStreamer, ahead_deg: float = 10.0, steps: int = 1
    ) -> None:
        self._ahead_rad, self._step_ns = np.radians(ahead_deg), steps * PERIOD_NS
        self._up_m = HEIGHT_M + float(assets.world.ground_height(0.0, 0.0))
        times = range(0, (COUNT + 4) * self._step_ns, 20_000_000)
        self._track = PoseTrack([(t, self.pose(t)) for t in times])
        origin = TileCache.open(assets.map_cache).frame.ecef_from_enu
        live = TileCache.open(assets.live_cache).frame.ecef_from_enu
        self._options = CameraOptions(scene_from_world=live.inverse @ origin)
        self._renderer = NumbaRenderer(streamer)

    def pose(self, time_ns: int) -> Pose:
        """Where the camera is."""
        down = so3_exp([self._ahead_rad, 0.0, 0.0]) @ np.diag([1.0, -1.0, -1.0])
        return Pose(down, np.array([0.0, 8e-9 * time_ns - 40.0, self._up_m]))

    def frame(self, k: int, factor: float) -> Frame:
        """The k-th picture, of a lens so many times longer."""
        lens = with_focal_factor(LENS, factor)
        camera = WorldCamera(self._renderer, lens, Appearance(), self._options)
        seen = camera.expose(k * self._step_ns, self._track)
        return Frame(seen.image, seen.time_ns, lens, k)

    def prior(self) -> PosePrior:
        """At the first picture."""
        begun = PosePrior(self.pose(self._step_ns), np.eye(6) * 0.01, self._step_ns)
        return replace(begun, velocity=np.array([0.0, 8.0, 0.0]))

    def off_m(self, estimate: PoseEstimate) -> float:
        """How far it is beside the truth; inf where it is not given out."""
        true = self.pose(estimate.exposure_time_ns)
        given = estimate.accepted
        return estimate.world_from_camera.distance_to(true)[0] if given else float("inf")


@pytest.fixture(scope="module")
def streamer(small_assets: FlightAssets) -> Iterator[TileStreamer]:
    with TileStreamer(TileCache.open(small_assets.live_cache)) as streamer:
        yield streamer


@pytest.fixture(scope="module")
def flight(small_assets: FlightAssets, streamer: TileStreamer) -> Flight:
    return Flight(small_assets, streamer)


@contextmanager
def localizer_of(
    flight: Flight, assets: FlightAssets, config: LocalizerConfig = CONFIG
) -> Iterator[Localizer]:
    sensors = AuxiliarySensors(lambda time_ns: flight.pose(time_ns).rotation)
    with open_localizer(assets.map_cache, LENS, config, sensors) as localizer:
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


def test_on_rendered_pictures_the_table_s_error_is_found(streamer, small_assets):
    """1 % longer than the table has it: 0.8 m at 80 m above ground."""
    flight = Flight(small_assets, streamer, ahead_deg=35.0, steps=2)
    table = ZoomTable(points=BELIEVED, refine=0.015)
    zoomed = ZoomedFrames(table, lambda _time_ns, _hold_s: 0.0, pytest.fail)
    config = CONFIG.model_copy(update={"focal_fit_s": 0.01})
    off_m = []
    with localizer_of(flight, small_assets, config) as localizer:
        for k in range(1, COUNT + 3):
            taken = zoomed(replace(flight.frame(k, 1.01), camera=LENS))
            found = localizer.track(taken)
            zoomed.learn(found)
            off_m.append(flight.off_m(found))
    assert taken.camera.fx / LENS.fx == pytest.approx(1.01, abs=0.003)
    assert np.mean(off_m[-3:]) < 0.6 * np.mean(off_m[:3])


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
