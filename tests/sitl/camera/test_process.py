"""The world camera as a process: true poses in, a stream that the companion reads out."""

from __future__ import annotations

import json
import multiprocessing
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image as PilImage

from companion.geometry import GimbalAngles
from companion.offline.record import poses, read_columns
from companion.sources import SourceSettings, StreamState, open_source
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import matrix_from_euler, quaternion_from_matrix
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import Appearance
from localizer.types import Frame
from sitl.camera.faults import PictureFault
from sitl.camera.process import WorldCameraConfig, WorldCameraProcess
from sitl.camera.true_motion import TruthSample
from sitl.errors import WorldCameraError

ORIGIN = Geodetic(47.05, 8.31, 440.0)
CAMERA = Camera.from_fov(320, 240, 60.0)
RATE_HZ = 8.0


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Flat ground of 400 m with random blocks of colour, through the real importer."""
    folder = tmp_path_factory.mktemp("flat")
    colours = np.random.default_rng(1).integers(30, 230, (50, 50, 3), np.uint8)
    texture = PilImage.fromarray(colours.repeat(16, 0).repeat(16, 1))
    h = 200.0
    # glTF is y-up: (east, up, -north).
    corners = [[-h, 0, h], [h, 0, h], [h, 0, -h], [-h, 0, -h]]
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=texture)
    visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(folder / "ground.glb")
    tileset = {
        "asset": {"version": "1.1"},
        "geometricError": 10,
        "root": {
            "transform": LocalFrame(ORIGIN).ecef_from_enu.matrix.T.ravel().tolist(),
            "boundingVolume": {"box": [0, 0, 0, h, 0, 0, 0, h, 0, 0, 0, 5]},
            "geometricError": 0,
            "refine": "REPLACE",
            "content": {"uri": "ground.glb"},
        },
    }
    (folder / "tileset.json").write_text(json.dumps(tileset))
    build_cache(
        folder / "tileset.json",
        folder / "cache",
        BuildOptions(geoid_separation_m=47.0, origin=ORIGIN, workers=1),
    )
    return folder / "cache"


def _config(cache: Path, log: Path, url: str) -> WorldCameraConfig:
    return WorldCameraConfig(
        cache, ORIGIN, CAMERA, url, log, rate_hz=RATE_HZ, appearance=Appearance(read_noise=0.004)
    )


def _sample(time_ns: int, start_ns: int) -> TruthSample:
    """A vehicle that flies east at 8 m/s, 80 m up, banking a little."""
    t = (time_ns - start_ns) * 1e-9
    body = quaternion_from_matrix(matrix_from_euler(0.05 * np.sin(t), -0.1, 1.2))
    gimbal = GimbalAngles(0.0, np.radians(-80.0), 0.1 * t)
    return TruthSample(time_ns, np.array([8.0 * t - 10.0, 5.0, 80.0]), body, gimbal)


class _Flight:
    """Sends truth at 50 Hz from a thread, as a flight script does."""

    def __init__(self, process: WorldCameraProcess) -> None:
        self._process = process
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> _Flight:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        start = time.monotonic_ns()
        while not self._stop.wait(0.02):
            self._process.send(_sample(time.monotonic_ns(), start))


def _free_url() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return f"udp://127.0.0.1:{s.getsockname()[1]}"


def test_streams_what_the_true_pose_sees_and_stops_and_resumes(cache: Path, tmp_path: Path) -> None:
    url, log = _free_url(), tmp_path / "frames.csv"
    states: list[StreamState] = []
    source = open_source(
        url, CAMERA, SourceSettings(stall_timeout_s=0.6), lambda s, _: states.append(s)
    )
    received: list[tuple[Frame, int]] = []

    def watch() -> None:
        received.extend((f, time.monotonic_ns()) for f in source.frames())

    def wait_for(count: int) -> None:
        deadline = time.monotonic() + 120
        while source.counters.delivered < count:
            assert time.monotonic() < deadline, (source.counters, states)
            time.sleep(0.05)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    with WorldCameraProcess(_config(cache, log, url)) as process, _Flight(process):
        wait_for(12)
        process.send(PictureFault("silent"))
        deadline = time.monotonic() + 120
        while states[-1] is not StreamState.STALLED:
            assert time.monotonic() < deadline, states
            time.sleep(0.05)
        process.send(None)
        wait_for(source.counters.delivered + 8)
    source.close()
    watcher.join(120)
    assert not watcher.is_alive()

    statistics = process.statistics
    assert statistics is not None
    print(f"\n{statistics}")
    truth = read_columns(log)
    true_poses = poses(truth)
    times = truth["exposure_time_ns"]
    assert len(times) == statistics.frames >= len(received)
    # At the configured rate; what the pause or a busy machine costs are whole exposures.
    periods = np.diff(times) / (1e9 / RATE_HZ)
    assert periods.min() == 1
    np.testing.assert_array_equal(periods, np.rint(periods))

    # Every received picture belongs to a logged exposure, and shows what the map shows from there.
    streamer = TileStreamer(TileCache.open(cache))
    renderer = NumbaRenderer(streamer, threads=1)
    latencies = []
    for frame, seen_ns in received[::4]:
        k = int(np.argmin(np.abs(times - frame.exposure_time_ns)))
        assert abs(int(times[k]) - frame.exposure_time_ns) < 100_000
        view = renderer.render(true_poses[k], CAMERA, wait=True)
        difference = np.abs(view.rgb.astype(int) - frame.image)
        assert difference.mean() < 12  # H.264 and noise; another frame's view gives more than 40
        latencies.append((seen_ns - frame.exposure_time_ns) / 1e6)
    print(f"glass to glass, ms: {np.round(latencies)}")
    other = renderer.render(true_poses[0], CAMERA, wait=True).rgb.astype(int)
    assert np.abs(other - received[-1][0].image).mean() > 25
    streamer.close()


def test_a_missing_cache_is_an_error_in_the_parent(tmp_path: Path) -> None:
    config = _config(tmp_path / "nowhere", tmp_path / "frames.csv", _free_url())
    with pytest.raises(WorldCameraError, match="nowhere"), WorldCameraProcess(config):
        pass


def test_a_process_that_died_is_an_error_at_the_next_sample(cache: Path, tmp_path: Path) -> None:
    config = _config(cache, tmp_path / "frames.csv", _free_url())
    with WorldCameraProcess(config) as process:
        (child,) = (c for c in multiprocessing.active_children() if c.name == "world-camera")
        child.kill()
        child.join()
        with pytest.raises(WorldCameraError, match="died"):
            process.send(_sample(0, 0))
