"""``companion shadow-check`` on a generated flight: a .bin beside its video."""

import json
import math
from fractions import Fraction

import av
import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.trial.deployment import footage_settings
from localizer.config import LocalizerConfig
from localizer.geometry.camera import Camera
from localizer.geometry.geo import NED_FROM_ENU
from localizer.geometry.pose import Pose, matrix_from_euler
from localizer.map.cache.cache import TileCache
from localizer.tracking.opening import MapStack
from tests.companion.recorded.logs import write_dataflash

_RATE_HZ, _SECONDS, _BEFORE_S = 5, 14, 6.0
_DOWN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # camera to body
_CAMERA = Camera.from_fov(320, 240, 65.0)


def _motion(t):
    """Northward at 80 m, swaying and turning."""
    s = t - _BEFORE_S
    east, roll, yaw = 6.0 * math.sin(0.5 * s), 0.12 * math.sin(0.9 * s), 0.4 * math.sin(0.6 * s)
    return 6.0 * s - 42.0, east, 80.0, roll, 0.0, yaw


@pytest.fixture(scope="module")
def flight(small_assets, tmp_path_factory):
    """A folder with flight.mp4 of the small world, and where its map has its origin."""
    folder = tmp_path_factory.mktemp("flight")
    stack = MapStack(small_assets.map_cache, LocalizerConfig())
    with av.open(str(folder / "flight.mp4"), "w") as out:
        stream = out.add_stream("libx264", rate=_RATE_HZ)
        stream.width, stream.height, stream.pix_fmt = _CAMERA.width, _CAMERA.height, "yuv420p"
        for k in range(_RATE_HZ * _SECONDS):
            north, east, height, *angles = _motion(_BEFORE_S + k / _RATE_HZ)
            R = NED_FROM_ENU.T @ matrix_from_euler(*angles) @ _DOWN
            view = stack.renderer.render(Pose(R, np.array([east, north, height])), _CAMERA,
                                         wait=True)  # fmt: skip
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(view.rgb), format="rgb24")
            frame.pts, frame.time_base = k, Fraction(1, _RATE_HZ)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    stack.close()
    return folder


def _check(flight, map_cache, north_m=0.0, camera=("--fov", "65")):
    """The command's result and figures, for a log whose GNSS lies so far north."""
    manifest = TileCache.open(map_cache).manifest
    origin = (manifest.origin.latitude_deg + north_m / 111_195.0, manifest.origin.longitude_deg,
              manifest.origin.height_m - manifest.geoid_separation_m)  # fmt: skip
    log = write_dataflash(flight / "log.bin", _motion, _SECONDS + 2 * _BEFORE_S, origin=origin)
    figures = flight / "figures.json"
    figures.unlink(missing_ok=True)
    result = CliRunner().invoke(app, [
        "shadow-check", str(log), "--video", str(flight / "flight.mp4"), "--map", str(map_cache),
        *camera, "--json", str(figures),
    ])  # fmt: skip
    assert figures.exists(), result.output
    return result, json.loads(figures.read_text())


def test_a_flight_over_its_own_map_is_a_go(small_assets, flight):
    result, figures = _check(flight, small_assets.map_cache)
    assert result.exit_code == 0, result.output
    assert figures["accepted"] >= 0.95 * figures["frames"] > 60
    assert figures["passed"] == figures["judged"] >= 60
    assert figures["score"]["median_m"] < 0.5
    assert "shadow verdict: ready" in result.output


def test_a_map_that_lies_20_m_off_is_no_go(small_assets, flight):
    down = np.array([0.0, -90.0, 0.0])
    settings = footage_settings(small_assets.map_cache, _CAMERA, down, fixed=True)
    (flight / "deployment.yaml").write_text(json.dumps(settings))
    told = ("--config", str(flight / "deployment.yaml"))  # the video itself says no focal length
    result, figures = _check(flight, small_assets.map_cache, 20.0, told)
    assert result.exit_code == 1, result.output
    assert figures["score"]["bias_ne_m"] == pytest.approx([-20.0, 0.0], abs=0.5)
    assert "shadow verdict: not ready: median error " in result.output
