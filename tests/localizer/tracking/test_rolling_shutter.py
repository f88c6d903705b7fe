"""A gimbal slews at 60 degrees a second before a rolling shutter: localized, once it is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import Appearance
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.opening import open_localizer
from localizer.tracking.pipeline import Undistorter, working_camera
from localizer.types import Frame, PosePrior
from sitl.camera.realism import CameraRealism
from sitl.camera.true_motion import PoseTrack
from sitl.camera.world_camera import CameraOptions, WorldCamera
from sitl.demo.assets import FlightAssets

CAMERA = Camera(320, 240, 251.0, 251.0, 160.0, 120.0, readout_ms=20.0)
PERIOD_NS, COUNT = 100_000_000, 4


def _down(pitch_deg: float) -> Array:
    return so3_exp([np.radians(pitch_deg), 0.0, 0.0]) @ np.diag([1.0, -1.0, -1.0])


def _pose(time_ns: int, height_m: float) -> Pose:
    """Flies north at 10 m/s and looks up by 60 degrees a second."""
    time_s = 1e-9 * time_ns
    return Pose(_down(60.0 * time_s), np.array([0.0, 10.0 * time_s - 15.0, height_m]))


@pytest.fixture(scope="module")
def filmed(small_assets: FlightAssets) -> tuple[list[Frame], list[Pose]]:
    height_m = 90.0 + float(small_assets.world.ground_height(0.0, 0.0))
    track = PoseTrack([(t, _pose(t, height_m)) for t in range(0, 10 * PERIOD_NS, 5_000_000)])
    live = TileCache.open(small_assets.live_cache)
    streamer = TileStreamer(live)
    origin = TileCache.open(small_assets.map_cache).frame.ecef_from_enu
    options = CameraOptions(
        scene_from_world=live.frame.ecef_from_enu.inverse @ origin,
        realism=CameraRealism(readout_ms=CAMERA.readout_ms),
    )
    try:
        camera = WorldCamera(NumbaRenderer(streamer), CAMERA, Appearance(), options)
        seen = [camera.expose(k * PERIOD_NS, track) for k in range(1, COUNT + 1)]
    finally:
        streamer.close()
    frames = [
        Frame(e.image, e.time_ns, CAMERA, k) for k, e in enumerate(seen) if e is not None
    ]  # fmt: skip
    return frames, [e.world_from_camera for e in seen if e is not None]


def _errors_m(
    assets: FlightAssets, filmed: tuple[list[Frame], list[Pose]], readout_ms: float
) -> list[float]:
    frames, truth = filmed
    camera = replace(CAMERA, readout_ms=readout_ms)
    height_m = float(truth[0].translation[2])
    sensors = AuxiliarySensors(lambda time_ns: _pose(time_ns, height_m).rotation)
    errors = []
    config = LocalizerConfig(renderer="numba", device="cpu")
    with open_localizer(assets.map_cache, camera, config, sensors) as localizer:
        prior = PosePrior(truth[0], np.eye(6) * 0.01, frames[0].exposure_time_ns)
        localizer.set_prior(replace(prior, velocity=np.array([0.0, 10.0, 0.0])))
        for frame, true in zip(frames, truth, strict=True):
            estimate = localizer.track(replace(frame, camera=camera))
            assert estimate.accepted or not readout_ms
            errors.append(
                float(np.linalg.norm(estimate.world_from_camera.translation - true.translation))
            )
    return errors


def test_a_slew_is_localized_once_the_camera_states_its_readout(small_assets, filmed):
    unreported = _errors_m(small_assets, filmed, readout_ms=0.0)
    told = _errors_m(small_assets, filmed, readout_ms=CAMERA.readout_ms)
    assert np.median(unreported) > 1.0  # what is mended
    assert max(told) < 0.4


# --- A frame of another focal length: the working picture shows the world where it is -----------


CAMERA_ZOOM = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)
DIRECTION = np.array([0.12, -0.08, 1.0])


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.05, 1.6])
@pytest.mark.parametrize("bent", [0.0, -0.05])
def test_a_zoomed_frame_shows_a_light_in_its_true_direction(factor: float, bent: float) -> None:
    """A pinhole's pictures were only resized: the light of a 5 % longer lens was 1.8 px off."""
    lens = replace(CAMERA_ZOOM, distortion=(bent, 0.0, 0.0, 0.0, 0.0))
    source = replace(lens, fx=600.0 * factor, fy=600.0 * factor)
    target = working_camera(lens, 320)
    (u, v), _ = source.project(DIRECTION)
    rows, columns = np.mgrid[:480, :640] + 0.5
    light = 255.0 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 6.0**2))
    image = np.repeat(light[..., None], 3, axis=2).astype(np.uint8)
    seen = Undistorter(source, target)(Frame(image, 0, source, 0))[..., 0].astype(float)
    rows, columns = np.mgrid[: target.height, : target.width] + 0.5
    found = np.array([(seen * columns).sum(), (seen * rows).sum()]) / seen.sum()
    wanted, _ = target.project(DIRECTION)
    assert np.abs(found - wanted).max() < 0.15


def test_a_lens_is_another_from_a_thousandth_on() -> None:
    """Below it new undistortion maps would cost more than they mend."""
    for share, alike in ((0.0, True), (0.0005, True), (0.002, False)):
        f = 600.0 * (1.0 + share)
        assert CAMERA_ZOOM.is_like(replace(CAMERA_ZOOM, fx=f, fy=f)) == alike
    assert not CAMERA_ZOOM.is_like(replace(CAMERA_ZOOM, cx=321.0))
    assert not CAMERA_ZOOM.is_like(CAMERA_ZOOM.resized(320, 240))
