"""A folder of images as a camera feed: every image in order of name."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2

from companion.errors import StreamDecodeError, StreamOpenError
from companion.sources.base import (
    GREY_RANGE_ADVICE,
    FrameSource,
    SourceSettings,
    StateCallback,
    StreamState,
    fitted_camera,
)
from localizer.errors import GreyRangeError
from localizer.geometry.camera import Camera
from localizer.pictures import GreyRange, decode_rgb
from localizer.plain_files import files_of, plain_bytes, plain_text
from localizer.types import Frame, Image

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff"})
TIMESTAMPS_NAME = "timestamps.txt"


def list_images(folder: Path) -> list[Path]:
    """The folder's images in natural order (img2 before img10). `StreamOpenError` if the folder
    does not exist or has none.
    """
    if not folder.is_dir():
        raise StreamOpenError(f"{folder}: no such folder; give a folder of images")
    images = files_of(folder, IMAGE_SUFFIXES)
    if not images:
        raise StreamOpenError(
            f"{folder}: holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}); "
            "give the folder that directly contains them"
        )
    return sorted(images, key=_natural_key)


def read_image(path: Path, grey_range: GreyRange | None = None) -> Image:
    """RGB image (H, W, 3) uint8 in the sensor's own orientation (EXIF rotation is not applied).

    grey_range: `SourceSettings.grey_range`; 16-bit grey without it is a `StreamDecodeError`.
    """
    try:
        rgb = decode_rgb(plain_bytes(path), turned=False, grey_range=grey_range)
    except GreyRangeError as error:
        raise StreamDecodeError(f"{path}: {error}; {GREY_RANGE_ADVICE}") from error
    except (OSError, cv2.error) as error:
        raise StreamDecodeError(f"{path}: cannot be read: {error}") from error
    if rgb is None:
        raise StreamDecodeError(f"{path}: not an image, or damaged; remove or replace it")
    return rgb


def read_timestamps(path: Path) -> dict[str, int]:
    """Image name to exposure time in ns, from lines ``name time_ns`` (blank or comma between). "#"
    begins a comment; of a repeated name the last line counts. `StreamDecodeError` if the file
    cannot be read or a line is malformed.
    """
    times: dict[str, int] = {}
    try:
        lines = plain_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise StreamDecodeError(f"{path}: cannot be read: {error}") from error
    for number, line in enumerate(lines, start=1):
        text = line.split("#", 1)[0].replace(",", " ").split()
        if not text:
            continue
        try:
            name, value = text
            times[name] = int(value)
        except ValueError as error:
            raise StreamDecodeError(
                f"{path}, line {number}: expected 'name time_ns', got {line!r}"
            ) from error
    return times


def exposure_times_of(folder: Path, images: Sequence[Path]) -> tuple[int, ...] | None:
    """Exposure times (ns) of the images, from the folder's ``timestamps.txt``; None without that
    file. `StreamOpenError` if an image is missing in it.
    """
    file = folder / TIMESTAMPS_NAME
    if not file.exists():
        return None
    by_name = read_timestamps(file)
    missing = [path.name for path in images if path.name not in by_name]
    if missing:
        raise StreamOpenError(
            f"{file}: has no time for {len(missing)} of {len(images)} images, first {missing[0]}; "
            "add them or remove the file"
        )
    return tuple(by_name[path.name] for path in images)


class FolderSource(FrameSource):
    """Frames from the images of a folder (`StreamOpenError` without any). Exposure times (ns) are
    those of ``timestamps.txt``; without that file, they begin when `frames` does and follow at
    `rate_hz`. With `realtime`, recorded times are shifted to begin then.
    """

    def __init__(
        self,
        folder: Path,
        camera: Camera,
        settings: SourceSettings | None = None,
        on_state: StateCallback | None = None,
    ) -> None:
        super().__init__(camera, settings, on_state)
        self._folder = folder
        self._images = list_images(folder)
        self._times = exposure_times_of(folder, self._images)
        self._closed = threading.Event()

    def frames(self) -> Iterator[Frame]:
        """Every image; raises `StreamDecodeError` or `StreamSizeError`, which name the file."""
        start = time.monotonic_ns()
        first = self._times[0] if self._times else 0
        recorded = bool(self._times) and not self._settings.realtime
        self._report(StreamState.LIVE, f"{self._folder}: {len(self._images)} images")
        for sequence, path in enumerate(self._images):
            offset = self._offset_ns(sequence, first)
            if self._settings.realtime:
                self._closed.wait((start + offset - time.monotonic_ns()) / 1e9)
            if self._closed.is_set():
                return
            frame = self._load(path, (first if recorded else start) + offset, sequence)
            self._count(received=1, delivered=1)
            yield frame
        self._report(StreamState.ENDED, f"{self._folder}: all {len(self._images)} images delivered")

    def close(self) -> None:
        """End `frames` after the present image."""
        self._closed.set()
        self._report(StreamState.CLOSED, f"{self._folder}: closed")

    def _load(self, path: Path, time_ns: int, sequence: int) -> Frame:
        try:
            image = read_image(path, self._settings.grey_range)
            height, width = image.shape[:2]
            camera = fitted_camera(width, height, self._camera, str(path))
        except Exception as error:
            self._report(StreamState.FAILED, str(error))
            raise
        self._report_scaling(camera, str(path))
        return Frame(image, time_ns, camera, sequence)

    def _offset_ns(self, sequence: int, first: int) -> int:
        if self._times:
            return self._times[sequence] - first
        return round(sequence * 1e9 / self._settings.rate_hz)


def _natural_key(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]
