"""Reads settings from vehicle, stream and map, for a deployment file."""

from __future__ import annotations

import threading
from pathlib import Path

from companion.errors import StreamError, StreamSizeError
from companion.sources import SourceSettings, StreamState, open_source
from companion.sources.folder_source import list_images, read_image
from localizer.geometry.camera import Camera

_FIRST_PICTURE_S = 10.0
_GUESS = Camera.from_fov(1280, 720, 65.0)  # any: a picture says its size, this only names one
_ANY_GREY = (0, 65535)  # of a size, levels do not matter


def read_stream_size(source: str) -> tuple[int, int]:
    """Width and height, pixels, of a stream's frames or of a folder's first image; `StreamError` if
    none in 10 s.
    """
    if "://" not in source and Path(source).is_dir():  # pictures are taken at their own size there
        height, width = read_image(list_images(Path(source))[0], _ANY_GREY).shape[:2]
        return width, height
    told: list[str] = []

    def on_state(state: StreamState, text: str) -> None:
        if state is StreamState.STALLED:
            told.append(text)

    feed = open_source(source, _GUESS, SourceSettings(grey_range=_ANY_GREY), on_state)
    timer = threading.Timer(_FIRST_PICTURE_S, feed.close)
    timer.start()
    try:
        for frame in feed.frames():
            height, width = frame.image.shape[:2]
            return width, height
    except StreamSizeError as error:  # of another shape than the guess, as most thermal ones are
        if error.size is None:
            raise
        return error.size
    finally:
        timer.cancel()
        feed.close()
    why = f": {told[-1]}" if told else ""
    raise StreamError(f"no picture in {_FIRST_PICTURE_S:.0f} s{why}")
