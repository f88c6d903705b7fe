"""What vehicle, stream and map say of themselves, for a deployment file."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

from companion.errors import StreamError
from companion.sources import SourceSettings, open_source
from companion.sources.folder_source import list_images, read_image
from localizer.geometry.camera import Camera

_FIRST_PICTURE_S = 10.0
_GUESS = Camera.from_fov(1280, 720, 65.0)  # any: a picture says its size, this only names one


@dataclass(frozen=True)
class Seen:
    """Size of a stream's pictures, pixels."""

    width: int
    height: int


def first_picture(source: str) -> Seen:
    """The size of the stream's pictures; StreamError where none comes in time."""
    if "://" not in source and Path(source).is_dir():  # pictures are taken at their own size there
        height, width = read_image(list_images(Path(source))[0]).shape[:2]
        return Seen(width, height)
    feed = open_source(source, _GUESS, SourceSettings())
    timer = threading.Timer(_FIRST_PICTURE_S, feed.close)
    timer.start()
    try:
        for frame in feed.frames():
            height, width = frame.image.shape[:2]
            return Seen(width, height)
    finally:
        timer.cancel()
        feed.close()
    raise StreamError(f"no picture in {_FIRST_PICTURE_S:.0f} s")
