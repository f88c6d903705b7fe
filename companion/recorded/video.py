"""Extracts images from a video file, with their times from its first frame."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import av
import cv2

from companion.errors import FootageError
from companion.sources.base import video_stream
from localizer.pictures import write_rgb
from localizer.types import Image

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".mkv", ".avi", ".ts", ".m2ts", ".mpg", ".mpeg", ".webm",
     ".h264", ".264", ".h265", ".265", ".hevc", ".mjpeg"}
)  # fmt: skip
_RATE_HZ = 30.0  # of a file that has no times, and no rate in its headers
_LARGEST_PX = 1920  # of an image's width: registration works on less
_NO_CLOCK_YEAR = 2000  # of a camera whose clock was never set: 1904 or 1970
_QUALITY_SUFFIX = ".jpg"


@dataclass(frozen=True)
class ExtractedFrame:
    """An extracted image file. time_ns: from the video's first frame."""

    path: Path
    time_ns: int
    width: int
    height: int


@dataclass(frozen=True)
class VideoFacts:
    """Properties of a video file. has_dji_track: whether it has DJI's own telemetry (protobuf,
    different for each model); assumed: about its times, empty if it has some; day: of the
    recording, UTC, None if unknown.
    """

    duration_s: float
    rotation_deg: int
    has_dji_track: bool
    assumed: str
    day: date | None = None


def video_facts(path: Path) -> VideoFacts:
    """Size, duration and orientation; `FootageError` if the file is no video."""
    try:
        with av.open(str(path)) as container:
            stream = video_stream(container, str(path))
            frame = next(container.decode(stream), None)
            if frame is None:
                raise FootageError(f"{path}: no frame in it can be decoded")
            rotation = round(getattr(frame, "rotation", 0) or 0)
            names = [str(s.metadata.get("handler_name", "")) for s in container.streams.data]
            has_track = any(re.search(r"(DJI|CAM)\W?meta", name, re.IGNORECASE) for name in names)
            assumed = "" if frame.pts is not None else _assumed(path, stream)
            said = container.duration
            duration_s = said / av.time_base if said else _length_s(path)
            day = _day(container.metadata.get("creation_time", ""))
            return VideoFacts(duration_s, rotation, has_track, assumed, day)
    except av.error.FFmpegError as error:
        raise FootageError(f"{path}: not a video, or damaged: {error}") from error


def _day(text: str) -> date | None:
    try:
        day = date.fromisoformat(text[:10])
    except ValueError:
        return None
    return day if day.year > _NO_CLOCK_YEAR else None


def _assumed(path: Path, stream: av.VideoStream) -> str:
    stated = stream.codec_context.framerate
    by = "as its headers say" if stated else "which is assumed"
    return (
        f"the video has no times in it: {float(stated or _RATE_HZ):g} frames a second, {by}; if it "
        f"was filmed at another rate: ffmpeg -r RATE -i {path.name} -c copy {path.stem}.mp4"
    )


def _length_s(path: Path) -> float:
    """Duration by the packets, s, of a file that does not state it."""
    with av.open(str(path)) as container:
        stream = video_stream(container, str(path))
        stamps = [packet.pts for packet in container.demux(stream) if packet.size]
        known = [pts for pts in stamps if pts is not None]
        if known and stream.time_base is not None:
            return float((max(known) - min(known)) * stream.time_base)
        return len(stamps) / float(stream.codec_context.framerate or _RATE_HZ)


def extract_frames(
    path: Path, folder: Path, times_ns: list[int], progress: Callable[[int, int], None]
) -> list[ExtractedFrame]:
    """Write the first frame at or after each of the ascending times as a JPEG, at most 1920 px
    wide, into the folder, which is created. Times count from the first frame. A frame is written
    once, so there may be fewer than times. progress: called with (written, times). `FootageError`
    if no frame can be decoded.
    """
    folder.mkdir(parents=True, exist_ok=True)
    frames: list[ExtractedFrame] = []
    wanted = list(times_ns)
    for time_ns, picture in _pictures(path):
        if not wanted:
            break
        if time_ns < wanted[0]:
            continue
        while wanted and wanted[0] <= time_ns:
            wanted.pop(0)
        image = _shrunk(picture.to_ndarray(format="rgb24"))
        file = folder / f"frame-{time_ns / 1e9:08.3f}s{_QUALITY_SUFFIX}"
        write_rgb(file, image)
        frames.append(ExtractedFrame(file, time_ns, image.shape[1], image.shape[0]))
        progress(len(frames), len(times_ns))
    if not frames:
        raise FootageError(f"{path}: no frame in it can be decoded")
    return frames


def _pictures(path: Path) -> Iterator[tuple[int, av.VideoFrame]]:
    first: int | None = None
    count = 0
    try:
        with av.open(str(path)) as container:
            stream = video_stream(container, str(path))
            stream.thread_type = "AUTO"
            rate = float(stream.codec_context.framerate or _RATE_HZ)
            for packet in container.demux(stream):
                try:
                    pictures = packet.decode()
                except av.error.InvalidDataError:  # a damaged frame: the next ones may be good
                    continue
                for picture in pictures:
                    own = picture.pts * picture.time_base if picture.pts is not None else None
                    stamp = (
                        round(1e9 * float(own)) if own is not None else round(1e9 * count / rate)
                    )
                    first = stamp if first is None else first
                    count += 1
                    yield stamp - first, picture
    except av.error.FFmpegError as error:
        if first is None:
            raise FootageError(f"{path}: not a video, or damaged: {error}") from error


def _shrunk(image: Image) -> Image:
    height, width = image.shape[:2]
    if width <= _LARGEST_PX:
        return image
    size = (_LARGEST_PX, round(height * _LARGEST_PX / width))
    shrunk: Image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return shrunk
