"""Images of a report: the map from above, and frames beside the rendered map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from companion.errors import RecordError, StreamDecodeError
from companion.offline.record import FlownMap
from companion.reporting.content import MapMark, MapSheet, MapTrack, Overlay
from companion.sources.folder_source import read_image
from companion.terminal.steps import Say
from localizer.errors import LocalizerError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.base import MapRenderer
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import render_top_view
from localizer.tracking.pipeline import Undistorter
from localizer.types import Frame, Image

_SHEET_PX = 900
_MARGIN_M = 60.0


def silent(_: str) -> None:
    """A progress callback that does nothing."""


@dataclass(frozen=True)
class ShownFrame:
    """A recorded frame with its estimated pose."""

    path: Path
    world_from_camera: Pose
    caption: str


@dataclass(frozen=True)
class MapPictures:
    """Renders images of one map. notes: what could not be drawn; say: gets progress."""

    cache: TileCache | None
    renderer: MapRenderer | None
    notes: list[str] = field(default_factory=list)
    say: Say = silent

    def sheet(self, tracks: Sequence[MapTrack], marks: Sequence[MapMark]) -> MapSheet | None:
        """Top view of the square about all tracks and marks, with 60 m around; None without any.
        Without a map it has no image.
        """
        places = [t.points[np.isfinite(t.points).all(axis=1)] for t in tracks]
        points = np.vstack([*places, *([[m.east_m, m.north_m]] for m in marks), np.empty((0, 2))])
        if not len(points):
            return None
        low, high = points.min(axis=0), points.max(axis=0)
        half = float((high - low).max()) / 2 + _MARGIN_M
        east, north = (low + high) / 2
        rgb = self._from_above(np.array([east, north]), half)
        west, south = float(east) - half, float(north) - half
        edges = (west, west + 2 * half, south, south + 2 * half)
        return MapSheet(rgb, *edges, tuple(tracks), tuple(marks))

    def _from_above(self, centre: np.ndarray, half_m: float) -> Image | None:
        if self.renderer is None or self.cache is None:
            return None
        self.say("drawing the map from above")
        base_m = float(self.cache.index.box_min[0, 2])
        gsd_m = 2 * half_m / _SHEET_PX
        return render_top_view(self.renderer, centre, _SHEET_PX, gsd_m, base_m).rgb

    def overlays(
        self, frames: Sequence[ShownFrame], camera: Camera, size: Camera | None = None
    ) -> tuple[Overlay, ...]:
        """Each frame, undistorted, and the map rendered at its pose; () without a map. A frame that
        cannot be used is left out and noted. camera: of the frames; size: the same camera at the
        size of the overlays, None: at its own.
        """
        if self.renderer is None:
            return ()
        target = (size or camera).without_distortion()
        undistort = Undistorter(camera, target)
        sheets = []
        for number, shown in enumerate(frames, 1):
            self.say(f"drawing overlay {number} of {len(frames)}")
            try:
                image = read_image(shown.path)
            except (StreamDecodeError, OSError) as error:  # power may have gone while written
                self.notes.append(f"left out: {error}")
                continue
            if image.shape[:2] != (camera.height, camera.width):
                self.notes.append(f"left out: {shown.path.name} is not of the calibrated size")
                continue
            video = undistort(Frame(image, 0, camera, 0))
            view = self.renderer.render(shown.world_from_camera, target, wait=True)
            sheets.append(Overlay(video, view.rgb, shown.caption))
        return tuple(sheets)


@contextmanager
def map_pictures(
    path: Path | None, say: Say = silent, flown: FlownMap | None = None
) -> Iterator[MapPictures]:
    """Context manager: images of the map in that folder; a note in the report if it cannot be used.
    flown: the record's data about its map, to reject a map with another origin.
    """
    if path is None:
        yield MapPictures(None, None, ["the map is not named: no images of it"])
        return
    try:
        cache = TileCache.open(path)
        if flown is not None:
            flown.require_frame(cache)
    except (LocalizerError, RecordError, OSError) as error:
        yield MapPictures(None, None, [f"no images of the map: {error}"])
        return
    doubt = "" if flown is None else flown.mismatch(cache)
    streamer = TileStreamer(cache)
    try:
        yield MapPictures(cache, NumbaRenderer(streamer), [doubt] if doubt else [], say)
    finally:
        streamer.close()
