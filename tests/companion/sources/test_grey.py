"""Grey pictures of 8 and of 16 bits, as thermal cameras give them, at every door."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage
from pydantic import ValidationError

from companion.errors import StreamDecodeError, StreamDepthError
from companion.setup.write import read_stream_size
from companion.sources import SourceSettings, StreamState, av_source, open_source
from companion.sources.folder_source import read_image
from localizer.errors import GreyRangeError, SequenceError
from localizer.evaluation.sequences import Sequence
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.types import Frame

CAMERA = Camera.from_fov(64, 48, 70.0)
RAMP = np.arange(64 * 48).reshape(48, 64)
GREY = (RAMP % 251).astype(np.uint8)
COUNTS = (7000 + 8 * (RAMP % 251)).astype(np.uint16)  # what a sensor fills of its 65536
RANGE = (7000, 7000 + 8 * 255)


def _video(path: Path, picture: np.ndarray, form: str) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, form
        for number in range(3):
            frame = av.VideoFrame.from_ndarray(picture, format=form)
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def _is_grey(image: np.ndarray, expected: np.ndarray, off: int = 0) -> bool:
    return bool(
        image.shape == (48, 64, 3)
        and image.dtype == np.uint8
        and np.abs(image.astype(int) - expected[..., None].astype(int)).max() <= off
    )


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.bmp", "a.jpg", "alpha.png"])
def test_grey_files_have_three_equal_channels(tmp_path: Path, name: str) -> None:
    picture = PillowImage.fromarray(GREY)
    (picture.convert("LA") if name == "alpha.png" else picture).save(tmp_path / name)
    expected = GREY
    if name == "a.jpg":
        expected = np.asarray(cv2.imread(str(tmp_path / name), cv2.IMREAD_GRAYSCALE), np.uint8)
    (frame,) = open_source(tmp_path, CAMERA).frames()
    assert _is_grey(frame.image, expected)
    assert _is_grey(_sequence(tmp_path / name).frame(0).image, expected)  # of `companion eval`


@pytest.mark.parametrize("name", ["counts.png", "counts.tif"])
def test_counts_in_files_need_their_range(tmp_path: Path, name: str) -> None:
    """By their upper bits alone they had nine levels, and nobody was told."""
    cv2.imwrite(str(tmp_path / name), COUNTS)
    with pytest.raises(StreamDecodeError, match=rf"{name}: 16-bit grey, here 7000 to 9000.*grey_r"):
        list(open_source(tmp_path, CAMERA).frames())
    (frame,) = open_source(tmp_path, CAMERA, SourceSettings(grey_range=RANGE)).frames()
    assert _is_grey(frame.image, GREY)
    middle = SourceSettings(grey_range=(8000, 8001))  # beyond it: black and white
    (frame,) = open_source(tmp_path, CAMERA, middle).frames()
    assert _is_grey(frame.image, np.where(COUNTS <= 8000, 0, 255))
    with pytest.raises(SequenceError, match=rf"{name}: 16-bit grey.*write it with 8 bits"):
        _sequence(tmp_path / name).frame(0)
    assert read_stream_size(str(tmp_path))[0] == 64  # `companion init` asks for the size alone


def _sequence(path: Path) -> Sequence:
    return Sequence((path,), (1,), (Pose.identity(),), CAMERA)


def test_other_kinds_of_grey_are_named(tmp_path: Path) -> None:
    for number, kind in enumerate((np.float32, np.int16)):
        cv2.imwrite(str(tmp_path / f"{number}.tif"), COUNTS.astype(kind))
        with pytest.raises(StreamDecodeError, match=r"8 or 16 bits without sign"):
            read_image(tmp_path / f"{number}.tif", RANGE)


@pytest.mark.parametrize(("form", "scale"), [("gray", 1), ("gray10le", 4), ("gray12le", 16)])
def test_monochrome_video_is_grey(tmp_path: Path, form: str, scale: int) -> None:
    picture = GREY if scale == 1 else GREY.astype(np.uint16) * scale
    frames = list(open_source(_video(tmp_path / "v.mkv", picture, form), CAMERA).frames())
    assert len(frames) == 3
    assert all(_is_grey(f.image, GREY, off=1) for f in frames)


def test_counts_in_a_video_need_their_range(tmp_path: Path) -> None:
    path = _video(tmp_path / "v.mkv", COUNTS, "gray16le")
    source = open_source(path, CAMERA)
    with pytest.raises(StreamDepthError, match=r"gray16le.*grey_range: \[black, white\]"):
        list(source.frames())
    assert source.state is StreamState.FAILED
    for frame in open_source(path, CAMERA, SourceSettings(grey_range=RANGE)).frames():
        assert _is_grey(frame.image, GREY)
    assert read_stream_size(str(path))[1] == 48


def test_live_counts_need_their_range(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a V4L2 camera of format Y16 gives them; here a file stands for the device."""
    path = _video(tmp_path / "v.mkv", COUNTS, "gray16le")
    made = av_source.live_input
    monkeypatch.setattr(
        av_source, "live_input",
        lambda *a: replace(made(*a), url=str(path), datagrams=None, format=None, options={}),
    )  # fmt: skip
    source = open_source("rtsp://127.0.0.1:1/", CAMERA)
    with pytest.raises(StreamDepthError, match="grey_range"):
        list(source.frames())
    assert source.state is StreamState.FAILED
    source = open_source("rtsp://127.0.0.1:1/", CAMERA, SourceSettings(grey_range=RANGE))
    assert _is_grey(next(source.frames()).image, GREY)
    source.close()
    assert read_stream_size("rtsp://127.0.0.1:1/")[1] == 48  # 4:3, and 16:9 was guessed


@pytest.mark.parametrize("wrong", [(9000, 7000), (5, 5), (-1, 9), (0, 65536), (1,)])
def test_a_range_that_is_none_is_refused(wrong: tuple[int, ...]) -> None:
    with pytest.raises(ValidationError, match="grey_range"):
        SourceSettings.model_validate({"grey_range": wrong})


def test_the_librarys_frame_takes_grey_and_names_counts() -> None:
    assert _is_grey(Frame(GREY, 0, CAMERA, 0).image, GREY)
    with pytest.raises(GreyRangeError, match=r"frame 7.*uint16"):
        Frame(COUNTS, 0, CAMERA, 7)
