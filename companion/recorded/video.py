"""Extracts images and telemetry from a video file, with their times from its first frame.

Telemetry in subtitles (.SRT) of DJI and Autel is of three kinds: ``[latitude: 1.2] [longitude: 3.4]
...`` in brackets (Mavic 2 and later), ``GPS (lon, lat, satellites), D .., H 98.00m`` (Mini, Air)
and ``GPS(lon,lat,n) BAROMETER:1.9`` (Mavic Pro, Phantom 4). Autel's has ``GPS(E: .., N: .., 26.1m)
... G.PRY (pitch, roll, yaw)``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from itertools import zip_longest
from pathlib import Path

import av
import cv2
import numpy as np

from companion.errors import FootageError
from companion.recorded.flight import (
    ABSOLUTE_M,
    Datum,
    Height,
    RecordedPosition,
    RecordedView,
    Telemetry,
)
from companion.sources.base import video_stream
from localizer.pictures import write_rgb
from localizer.plain_files import plain_bytes
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


_DATE = re.compile(r"\b(20\d\d)[-.](\d\d)[-.](\d\d)\s+\d\d:\d\d:\d\d")
_CUE = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_PAIR = re.compile(r"([A-Za-z_]+)\s*:\s*(-?\d+(?:\.\d+)?)")
_NUMBER = r"(-?\d+(?:\.\d+)?)"
_GPS = re.compile(rf"GPS\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}", re.IGNORECASE)
_AUTEL = re.compile(
    rf"GPS\s*\(\s*([EW]):\s*{_NUMBER}\s*,\s*([NS]):\s*{_NUMBER}\s*,\s*{_NUMBER}m", re.IGNORECASE
)
_AUTEL_GIMBAL = re.compile(rf"G\.PRY\s*\(\s*{_NUMBER}.?\s*,\s*{_NUMBER}.?\s*,\s*{_NUMBER}")
_HEIGHT = re.compile(rf"\bH\s+{_NUMBER}m")
_SIGMA_M = 3.0


@dataclass(frozen=True)
class Subtitles:
    """Telemetry of a file. samples: time from the video's start, ns; focal_35mm: of the lens; day:
    of the recording by the camera's clock; last_s: start of the last subtitle.
    """

    samples: tuple[Telemetry, ...]
    focal_35mm: float | None = None
    day: date | None = None
    last_s: float = 0.0


def read_subtitles(path: Path) -> Subtitles:
    """Read telemetry of a .SRT file; `FootageError` without any."""
    try:
        text = plain_bytes(path).decode("utf-8-sig", "replace")
    except OSError as error:
        raise FootageError(f"{path}: cannot be read: {error}") from error
    cues = list(_CUE.finditer(text))
    samples, focal = [], None
    for cue, after in zip_longest(cues, cues[1:]):
        body = text[cue.end() : after.start() if after else len(text)]
        body = re.sub(r"<[^>]*>", " ", body)
        hours, minutes, seconds, part = cue.groups()
        ms = ((int(hours) * 60 + int(minutes)) * 60 + int(seconds)) * 1000 + int(part.ljust(3, "0"))
        pairs = {k.lower(): float(v) for k, v in _PAIR.findall(body)}
        focal = focal or _focal(pairs)
        samples.append(_telemetry(body, pairs, ms * 1_000_000))
    if not any(s.position for s in samples):
        raise FootageError(
            f"{path}: {len(cues)} subtitles, none with a position: subtitles without telemetry, or "
            "of a kind that is not known"
        )
    return Subtitles(
        tuple(_without_repeats(samples)),
        focal,
        _day_of_text(text),
        (samples[-1].time_ns or 0) / 1e9,
    )


def _day_of_text(text: str) -> date | None:
    found = _DATE.search(text)
    try:
        return date(*map(int, found.groups())) if found is not None else None
    except ValueError:
        return None


def _telemetry(body: str, pairs: dict[str, float], time_ns: int) -> Telemetry:
    position, view = _bracketed(pairs), None
    if position is None:
        position = _in_words(body, pairs)
    gimbal = [pairs.get(f"gb_{name}") for name in ("roll", "pitch", "yaw")]
    told = [g for g in gimbal if g is not None]
    if len(told) == 3 and any(told):  # all zero: not measured
        view = RecordedView.of_angles(told[0], told[1], told[2])
    elif (found := _AUTEL_GIMBAL.search(body)) is not None:
        pitch, roll, yaw = (float(x) for x in found.groups())
        view = RecordedView.of_angles(roll, pitch, yaw)
    zoom = pairs.get("dzoom_ratio", 1.0)
    zoom = zoom / 10_000.0 if zoom >= 1000.0 else zoom
    return Telemetry(time_ns, position, view, None, zoom if zoom >= 1.0 else 1.0)


def _bracketed(pairs: dict[str, float]) -> RecordedPosition | None:
    # "longtitude" is how some of DJI's firmwares spell it.
    latitude = pairs.get("latitude")
    longitude = pairs.get("longitude", pairs.get("longtitude"))
    if latitude is None or longitude is None:
        return None
    heights = []
    if "rel_alt" in pairs:
        heights.append(Height.by_barometer(pairs["rel_alt"]))
    absolute = pairs.get("abs_alt", pairs.get("altitude"))
    if absolute is not None:
        heights.append(Height(absolute, Datum.AMSL, ABSOLUTE_M))
    return _position(latitude, longitude, heights)


def _in_words(body: str, pairs: dict[str, float]) -> RecordedPosition | None:
    autel = _AUTEL.search(body)
    if autel is not None:
        east, longitude, north, latitude, height = autel.groups()
        signs = (-1.0 if north.upper() == "S" else 1.0, -1.0 if east.upper() == "W" else 1.0)
        heights = [Height.by_barometer(float(height))]
        return _position(signs[0] * float(latitude), signs[1] * float(longitude), heights)
    gps = _GPS.search(body)
    if gps is None:
        return None
    longitude, latitude = float(gps[1]), float(gps[2])
    barometer = pairs.get("barometer")
    height = _HEIGHT.search(body)
    above = barometer if barometer is not None else float(height[1]) if height else None
    return _position(latitude, longitude, [] if above is None else [Height.by_barometer(above)])


def _position(latitude: float, longitude: float, heights: list[Height]) -> RecordedPosition | None:
    if (latitude == 0.0 and longitude == 0.0) or abs(latitude) > 90.0 or abs(longitude) > 360.0:
        return None  # no fix yet
    return RecordedPosition(latitude, longitude, _SIGMA_M, tuple(heights))


def _focal(pairs: dict[str, float]) -> float | None:
    """35 mm equivalent focal length, mm; older firmwares write ten times as much."""
    focal = pairs.get("focal_len")
    if focal is None or focal <= 0.0:
        return None
    return focal / 10.0 if focal >= 150.0 else focal


def _without_repeats(samples: list[Telemetry]) -> list[Telemetry]:
    """Samples without repeated positions: thirty subtitles a second hold one to ten positions."""
    kept: list[Telemetry] = []
    for sample in samples:
        same = kept and sample.position == kept[-1].position and _same_view(sample, kept[-1])
        if sample.position is not None and not same:
            kept.append(sample)
    last = samples[-1]
    if kept and last.position is not None and kept[-1].time_ns != last.time_ns:
        kept.append(last)
    return kept


def _same_view(a: Telemetry, b: Telemetry) -> bool:
    if a.view is None or b.view is None:
        return a.view is b.view
    return bool(np.array_equal(a.view.ned_from_camera, b.view.ned_from_camera))
