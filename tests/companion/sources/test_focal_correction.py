"""The zoom table is corrected by what pictures show: slowly, and within its bound."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.sources.zoom import FocalCorrection, ZoomedFrames, ZoomTable, with_focal_factor
from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import Appearance
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.opening import open_localizer
from localizer.types import (
    FocalFit,
    Frame,
    PoseEstimate,
    PosePrior,
)
from sitl.camera.true_motion import PoseTrack
from sitl.camera.world_camera import CameraOptions, WorldCamera
from sitl.demo.assets import FlightAssets
from tests.companion.estimates import estimated

CAMERA = Camera(320, 240, 251.0, 251.0, 160.0, 120.0)
PERIOD_NS, COUNT = 250_000_000, 9
BELIEVED = ((0.0, 1.0), (100.0, 2.0))


def _pose(time_ns: int, height_m: float) -> Pose:
    """Flies north at 10 m/s, looks 35 degrees ahead of straight down."""
    down = so3_exp([np.radians(35.0), 0.0, 0.0]) @ np.diag([1.0, -1.0, -1.0])
    return Pose(down, np.array([0.0, 1e-8 * time_ns - 40.0, height_m]))


def test_on_rendered_pictures_it_finds_the_lens(small_assets: FlightAssets) -> None:
    """1 % longer than the table has it: 0.9 m at 90 m above ground."""
    true = with_focal_factor(CAMERA, 1.01)
    height_m = 90.0 + float(small_assets.world.ground_height(0.0, 0.0))
    end_ns = (COUNT + 2) * PERIOD_NS
    track = PoseTrack([(t, _pose(t, height_m)) for t in range(0, end_ns, 20_000_000)])
    live = TileCache.open(small_assets.live_cache)
    streamer = TileStreamer(live)
    origin = TileCache.open(small_assets.map_cache).frame.ecef_from_enu
    options = CameraOptions(scene_from_world=live.frame.ecef_from_enu.inverse @ origin)
    table = ZoomTable(points=BELIEVED, refine=0.015)
    zoomed = ZoomedFrames(table, lambda _time_ns, _hold_s: 0.0, pytest.fail)
    config = LocalizerConfig(renderer="numba", device="cpu", focal_fit_s=0.01)
    sensors = AuxiliarySensors(lambda time_ns: _pose(time_ns, height_m).rotation)
    off: list[float] = []
    try:
        camera = WorldCamera(NumbaRenderer(streamer), true, Appearance(), options)
        with open_localizer(small_assets.map_cache, CAMERA, config, sensors) as localizer:
            prior = PosePrior(_pose(PERIOD_NS, height_m), np.eye(6) * 0.01, PERIOD_NS)
            localizer.set_prior(replace(prior, velocity=np.array([0.0, 10.0, 0.0])))
            for k in range(1, COUNT + 1):
                seen = camera.expose(k * PERIOD_NS, track)
                frame = zoomed(Frame(seen.image, seen.time_ns, CAMERA, k))
                assert frame is not None
                estimate = localizer.track(frame)
                zoomed.learn(estimate)
                away = estimate.world_from_camera.distance_to(seen.world_from_camera)
                off.append(away[0])
    finally:
        streamer.close()
    assert zoomed.factor == pytest.approx(1.01, abs=0.003)
    assert np.mean(off[-3:]) < 0.6 * np.mean(off[:3])


def estimate(time_ns: int, factor: float, sigma: float = 0.003) -> PoseEstimate:
    return estimated(time_ns=time_ns, quality=0.8, camera=CAMERA, focal=FocalFit(factor, sigma))


class Lens:
    """Says a level; its pictures fit a focal length that is `truth` times the table's."""

    def __init__(self, refine: float, truth: float) -> None:
        table = ZoomTable(points=BELIEVED, refine=refine)
        self.level, self.truth, self.time_ns = 0.0, truth, 0
        self.table = table
        self.zoomed = ZoomedFrames(table, lambda _time_ns, _hold_s: self.level, pytest.fail)

    def see(self, pictures: int) -> float:
        """The factor over the table's, after so many more."""
        by_table = self.table.factor(self.level)
        assert by_table is not None
        for _ in range(pictures):
            self.time_ns += PERIOD_NS
            frame = self.zoomed(Frame(np.zeros((240, 320, 3), np.uint8), self.time_ns, CAMERA, 0))
            given = frame.camera.fx / CAMERA.fx
            self.zoomed.learn(estimate(self.time_ns, by_table * self.truth / given))
        assert self.zoomed.factor is not None
        return self.zoomed.factor / by_table


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
    lens.see(0)
    lens.time_ns += PERIOD_NS
    lens.zoomed(Frame(np.zeros((240, 320, 3), np.uint8), lens.time_ns, CAMERA, 0))
    before = lens.zoomed.factor
    for _ in range(50):
        lens.zoomed.learn(estimate(taken_ns, 1.01))
        lens.zoomed.learn(estimate(12345, 1.01))  # of no picture that was given
    lens.see(1)
    assert lens.zoomed.factor == pytest.approx(before, rel=3e-3)
