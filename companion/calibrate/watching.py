"""Collects views of the board from a stream until there are enough."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from companion.calibrate.views import BoardView, BoardViews
from companion.setup.asking import read_stream_size
from companion.sources import SourceSettings, open_source
from companion.writing import make_folder
from localizer.geometry.camera import Camera
from localizer.pictures import write_rgb

OnView = Callable[[int, str, list[str]], None]
_QUIET_PICTURES = 30  # of the same word, after which it is said again


@dataclass(frozen=True)
class BoardViewing:
    """Result of the collection. missing: views that are still missing."""

    views: tuple[BoardView, ...]
    missing: tuple[str, ...]
    width: int
    height: int


def watch_board(
    source: str, seconds: float, on_view: OnView, keep: Path | None = None
) -> BoardViewing:
    """Collect views of the board until all are there, the source ends, or `seconds` have passed.

    source: as `open_source`. on_view: called after each change, and after each 30 images without
    one, with the number of views, the result of the newest image and the missing views. keep:
    folder for the images used, which is created; None for none. `StreamError` if the source fails.
    """
    size = read_stream_size(source)
    views = BoardViews(size.width, size.height)
    # Any model of the pictures' size: it is what is being looked for.
    camera = Camera.from_fov(size.width, size.height, 65.0)
    feed = open_source(source, camera, SourceSettings())
    timer = threading.Timer(seconds, feed.close)
    timer.daemon = True
    timer.start()
    if keep is not None:
        make_folder(keep, "--keep")
    last, quiet = "", 0
    try:
        for frame in feed.frames():
            word = views.add_image(frame.image)
            quiet = 0 if word != last else quiet + 1
            if word == "taken" and keep is not None:
                write_rgb(keep / f"view-{len(views.views):03d}.png", frame.image)
            if quiet % _QUIET_PICTURES == 0:
                on_view(len(views.views), word, views.missing())
            last = word
            if word == "taken" and not views.missing():
                break
    finally:
        timer.cancel()
        feed.close()
    return BoardViewing(tuple(views.views), tuple(views.missing()), size.width, size.height)
