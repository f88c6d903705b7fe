"""Video files and image folders."""

from __future__ import annotations

import time
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition

from companion.errors import StreamDecodeError, StreamOpenError, StreamSizeError
from companion.sources import SourceSettings, StreamState, open_source
from companion.sources.base import fitted_camera
from localizer.geometry.camera import Camera

CAMERA = Camera.from_fov(160, 120, 70.0)
COUNT = 12


def _image(level: int) -> np.ndarray:
    image = np.zeros((120, 160, 3), np.uint8)
    image[...] = (level, 255 - level, 40)
    return image


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "flight.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=20, options={"g": "4"})
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for i in range(COUNT):
            picture = av.VideoFrame.from_ndarray(_image(20 * i), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "images"
    path.mkdir()
    for i in range(COUNT):
        cv2.imwrite(str(path / f"img{i}.png"), _image(20 * i)[..., ::-1])
    return path


@pytest.mark.parametrize("kind", ["video", "folder"])
def test_every_image_comes_once_in_order_in_rgb(kind: str, request: pytest.FixtureRequest) -> None:
    states = []
    settings = SourceSettings(rate_hz=20)
    path = request.getfixturevalue(kind)
    source = open_source(path, CAMERA, settings, lambda s, _: states.append(s))
    frames = list(source.frames())
    for i, frame in enumerate(frames):
        assert frame.sequence == i
        expected = (20 * i, 255 - 20 * i, 40)
        assert np.abs(frame.image.reshape(-1, 3).mean(0) - expected).max() < 6
    steps = np.diff([f.exposure_time_ns for f in frames])
    assert len(frames) == COUNT
    np.testing.assert_allclose(steps, 50e6, atol=1e3)
    assert states == [StreamState.LIVE, StreamState.ENDED]
    assert source.counters.undecodable == 0  # B-frames that were held back are not lost
    assert source.counters.delivered == COUNT
    assert source.counters.dropped == 0


@pytest.mark.parametrize(("settings", "rate"), [({}, 50), ({"rate_hz": 25}, 25)])
@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_a_raw_stream_plays_at_its_own_rate_or_the_given_one(tmp_path, codec, settings, rate):
    """It has no presentation times; FFmpeg takes 25 pictures a second for granted."""
    form = {"libx264": "h264", "mpeg4": "m4v"}[codec]
    path = tmp_path / f"flight.{form}"
    with av.open(str(path), "w", format=form) as container:
        stream = container.add_stream(codec, rate=50)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for i in range(COUNT):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(_image(20 * i), format="rgb24")))
        container.mux(stream.encode())
    told = []
    source = open_source(
        path, CAMERA, SourceSettings(**settings), lambda _, text: told.append(text)
    )
    steps = np.diff([f.exposure_time_ns for f in source.frames()])
    np.testing.assert_allclose(steps, 1e9 / rate, atol=1e3)
    assert len(steps) == COUNT - 1
    by = "camera.settings.rate_hz" if settings else "its headers"
    assert f"no times in it: {rate} frames a second" in told[0]
    assert by in told[0]


@pytest.mark.parametrize("marked", [True, False])
@pytest.mark.parametrize("cover_first", [True, False])
def test_a_cover_picture_is_not_the_video(tmp_path, video, cover_first, marked):
    """Skydio writes one, and it may be stream 0; others write it as a track."""
    w, h = (64, 48) if marked else (640, 480)
    path = tmp_path / "covered.mp4"
    with av.open(str(video)) as source, av.open(str(path), "w") as container:
        cover = container.add_stream("mjpeg") if cover_first else None
        film = container.add_stream_from_template(source.streams.video[0])
        cover = cover or container.add_stream("mjpeg")
        cover.width, cover.height, cover.pix_fmt = w, h, "yuvj420p"
        if marked:
            cover.disposition = Disposition.attached_pic
        picture = av.VideoFrame.from_ndarray(np.zeros((h, w, 3), np.uint8), format="rgb24")
        container.mux(cover.encode(picture) + cover.encode())
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = film
                container.mux(packet)
    frames = list(open_source(path, CAMERA).frames())
    assert [frame.image.shape for frame in frames] == [(120, 160, 3)] * COUNT


@pytest.mark.parametrize("kind", ["video", "folder"])
def test_another_shape_than_the_cameras_is_named(kind: str, request: pytest.FixtureRequest) -> None:
    source = open_source(request.getfixturevalue(kind), Camera.from_fov(640, 360, 70.0))
    with pytest.raises(StreamSizeError, match=r"160x120.*640x360"):
        list(source.frames())
    assert source.state is StreamState.FAILED


@pytest.mark.parametrize("kind", ["video", "folder"])
def test_another_size_of_the_same_shape_scales_the_camera(kind, request):
    told = []
    calibrated = Camera(640, 480, 500.0, 510.0, 330.0, 236.0, (-0.1, 0.02, 0.001, -0.001, 0.0))
    source = open_source(
        request.getfixturevalue(kind), calibrated, on_state=lambda *state: told.append(state)
    )
    frames = list(source.frames())
    assert len(frames) == COUNT
    expected = Camera(160, 120, 125.0, 127.5, 82.5, 59.0, calibrated.distortion)
    assert all(f.camera == expected for f in frames)
    assert [s for s, _ in told] == [StreamState.LIVE, StreamState.SCALED, StreamState.ENDED]
    assert "160x120" in told[1][1]


@pytest.mark.parametrize(
    ("size", "model"),
    [
        ((1920, 1088), (1920, 1080)), ((960, 720), (1920, 1080)), ((1280, 1024), (1920, 1080)),
        ((8, 6), (640, 480)), ((1, 1), (640, 480)),
    ],
)  # fmt: skip
def test_a_padded_cropped_or_tiny_picture_is_no_scaled_one(size, model):
    camera = Camera.from_fov(*model, 70.0)
    with pytest.raises(StreamSizeError, match=f"camera delivers {size[0]}x{size[1]}"):
        fitted_camera(*size, camera, "camera")
    assert fitted_camera(model[0] // 2, model[1] // 2, camera, "camera").width == model[0] // 2


def test_timestamps_are_used_as_they_stand(folder: Path) -> None:
    lines = [f"img{i}.png {10**9 + i * 33_000_000}" for i in range(COUNT)]
    (folder / "timestamps.txt").write_text("# name time_ns\n" + "\n".join(lines))
    times = [f.exposure_time_ns for f in open_source(folder, CAMERA).frames()]
    assert times == [10**9 + i * 33_000_000 for i in range(COUNT)]


def test_timestamps_begin_now_in_real_time(folder: Path) -> None:
    """Or no attitude of the autopilot would be found at the frames' times."""
    lines = [f"img{i}.png {1_000_000 * i + 5}" for i in range(COUNT)]
    (folder / "timestamps.txt").write_text("\n".join(lines))
    before = time.monotonic_ns()
    source = open_source(folder, CAMERA, SourceSettings(realtime=True))
    times = [f.exposure_time_ns for f in source.frames()]
    assert before <= times[0] <= time.monotonic_ns()
    np.testing.assert_array_equal(np.diff(times), 1_000_000)


def test_timestamps_that_lack_an_image_or_are_no_numbers_are_named(folder: Path) -> None:
    (folder / "timestamps.txt").write_text("img0.png 1\n")
    with pytest.raises(StreamOpenError, match=r"11 of 12 images, first img1.png"):
        open_source(folder, CAMERA)
    (folder / "timestamps.txt").write_text("img0.png 1\nimg1.png soon\n")
    with pytest.raises(StreamDecodeError, match=r"line 2.*soon"):
        open_source(folder, CAMERA)


def test_a_damaged_image_is_named(folder: Path) -> None:
    (folder / "img3.png").write_bytes(b"not a picture")
    source = open_source(folder, CAMERA)
    with pytest.raises(StreamDecodeError, match=r"img3.png"):
        list(source.frames())
    assert source.counters.delivered == 3


def test_a_video_damaged_from_the_start_is_named(tmp_path: Path) -> None:
    path = tmp_path / "broken.mp4"
    path.write_bytes(b"\0" * 5000)
    with pytest.raises(StreamOpenError, match=r"broken.mp4"):
        list(open_source(path, CAMERA).frames())


def test_a_video_with_a_damaged_rest_gives_what_is_good(video: Path, tmp_path: Path) -> None:
    stream = tmp_path / "cut.ts"
    with av.open(str(video)) as source, av.open(str(stream), "w") as target:
        output = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = output
                target.mux(packet)
    data = bytearray(stream.read_bytes())
    half = len(data) // 2
    data[half:] = np.random.default_rng(0).bytes(len(data) - half)
    stream.write_bytes(data)
    frames = open_source(stream, CAMERA)
    count = len(list(frames.frames()))
    assert 0 < count < COUNT
    assert frames.state is StreamState.ENDED


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(StreamOpenError, match=r"nowhere"):
        open_source(tmp_path / "nowhere", CAMERA)
    with pytest.raises(StreamOpenError, match=r"holds no images"):
        open_source(tmp_path, CAMERA)
    with pytest.raises(StreamOpenError, match=r"gopher://.*use udp://"):
        open_source("gopher://host/1", CAMERA)
