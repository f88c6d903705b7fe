"""Images for the page: video as JPEG, edges of the map, the map at a pose, and its web map tiles.

Nothing is rendered: the view with which the localizer compared the frame arrives with its depth,
and is warped to the estimated pose.
"""

from __future__ import annotations

import json
import math
import struct
import threading
import time
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from companion.live.protocol import Message
from localizer.geometry.camera import Camera
from localizer.geometry.geo import lon_near
from localizer.geometry.pose import Pose, matrix_from_quaternion
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import render_top_view

_QUALITY = 75
_MOST_EDGES = 4000
_BLUR_PX = 1.2
_CANNY = (70, 150)
_STEPS = 2  # of the fixed point that finds where a ray meets the reference's surface
_NOWHERE = -1e4  # a pixel where nothing is seen
_GRID_PX = 4  # rays of the map's view are followed so far apart, and what they meet interpolated
WIDTHS_PX = (480, 640, 800, 960)  # of the pictures that pages get, so that they can share them


@dataclass(frozen=True)
class ReferenceImage:
    """The rendered view: rgb (h, w, 3), depth (h, w) m along the axis, 0 without a surface."""

    rgb: np.ndarray
    depth: np.ndarray
    camera: Camera
    pose: Pose


@dataclass(frozen=True)
class OverlayFrame:
    """A frame with its pose and rendered view. pose: world_from_camera, None without an estimate;
    view: None also for a rejected one; camera: of the image as sent.
    """

    image: np.ndarray
    camera: Camera
    pose: Pose | None
    view: ReferenceImage | None


def unpack(message: Message) -> OverlayFrame:
    """A frame's message as arrays, which are read-only views of its body. Images are RGB; the
    camera is resized to the image. ValueError if the body is too short.
    """
    head, body = message.head, message.body
    width, height = head["image"]
    camera = Camera.from_dict(head["camera"]).resized(width, height)
    size = 3 * width * height
    image = np.frombuffer(body, np.uint8, size).reshape(height, width, 3)
    estimate, shown = head.get("estimate"), head.get("view")
    pose = None if estimate is None else _pose(estimate["pose"])
    view = None
    if shown is not None:
        seen = Camera.from_dict(shown["camera"])
        n = seen.width * seen.height
        rgb = np.frombuffer(body, np.uint8, 3 * n, size).reshape(seen.height, seen.width, 3)
        depth = np.frombuffer(body, np.float32, n, size + 3 * n)
        view = ReferenceImage(
            rgb, depth.reshape(seen.height, seen.width), seen, _pose(shown["pose"])
        )
    return OverlayFrame(image, camera, pose, view)


def page_message(message: Message, with_map: bool, width_px: int = WIDTHS_PX[-1]) -> bytes:
    """The message for the page: uint32 length of the header, the header, then its parts.

    The header's `parts` are the lengths of the JPEG, the edges (uint16 pairs, pixels) and the map's
    JPEG. width_px: largest width of the image.
    """
    picture = reduced(unpack(message), width_px)
    parts = [_jpeg(picture.image), edges(picture).tobytes(), b""]
    if with_map and (warped := map_at_pose(picture)) is not None:
        parts[2] = _jpeg(warped)
    live = not message.head.get("recorded")
    head: dict[str, Any] = {
        "kind": "frame",
        "image": [picture.camera.width, picture.camera.height],
        "width_px": message.head["camera"]["width"],
        "estimate": message.head.get("estimate"),
        "exposure_ns": message.head["exposure_ns"],
        "exposure_utc_ms": utc_ms(message.head["exposure_ns"]) if live else None,
        # Where the age comes from: given out by the flight, made here.
        "published_utc_ms": utc_ms(message.head["published_ns"]) if live else None,
        "made_utc_ms": time.time() * 1e3,
        "footprint_enu_m": footprint(picture),
        "parts": [len(part) for part in parts],
    }
    text = json.dumps(head, separators=(",", ":")).encode()
    # Aligned, so that the page can look at the edges in place.
    text += b" " * (-(4 + len(text) + len(parts[0])) % 2)
    return struct.pack("<I", len(text)) + text + b"".join(parts)


def reduced(picture: OverlayFrame, width_px: int) -> OverlayFrame:
    """The frame and its camera reduced to this width; unchanged if it is not wider."""
    camera = picture.camera
    if camera.width <= width_px:
        return picture
    smaller = camera.resized(width_px, max(round(camera.height * width_px / camera.width), 1))
    size = (smaller.width, smaller.height)
    image = np.asarray(cv2.resize(picture.image, size, interpolation=cv2.INTER_AREA))
    return replace(picture, image=image, camera=smaller)


def utc_ms(monotonic_ns: int) -> float:
    """UTC (ms since 1970) of a CLOCK_MONOTONIC time, which all processes of a machine share."""
    return time.time() * 1e3 - (time.monotonic_ns() - monotonic_ns) * 1e-6


def edges(picture: OverlayFrame) -> np.ndarray:
    """Pixels of the map's edges in the frame at the estimated pose: (n, 2) uint16, each column and
    row. At most 4000, spread over the view. Empty without a pose or a rendered view.
    """
    nothing = np.empty((0, 2), np.uint16)
    view = picture.view
    if view is None or picture.pose is None:
        return nothing
    # Blurred: the edges of roofs and roads, not of every blade of grass.
    gray = cv2.GaussianBlur(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), (0, 0), _BLUR_PX)
    rows, columns = np.nonzero((cv2.Canny(gray, *_CANNY) > 0) & (view.depth > 0))
    if not len(rows):
        return nothing
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), _MOST_EDGES)).astype(int)
    rows, columns = rows[chosen], columns[chosen]
    points = _world(view, columns + 0.5, rows + 0.5, view.depth[rows, columns])
    pixels, inside = picture.camera.project(picture.pose.inverse.apply(points))
    return np.asarray(pixels[inside], np.uint16)


def map_at_pose(picture: OverlayFrame) -> np.ndarray | None:
    """The map as the camera saw it, (h, w, 3) uint8 RGB with distortion, at half size; None without
    a pose or a view of the map.

    The reference was rendered at the predicted pose; each pixel is moved to the estimated pose by
    its depth, in two iterations.
    """
    view, pose = picture.view, picture.pose
    if view is None or pose is None:
        return None
    half = picture.camera.resized(picture.camera.width // 2, picture.camera.height // 2)
    columns, rows = np.meshgrid(_knots(half.width), _knots(half.height))
    rays = half.rays(np.stack([columns, rows], axis=-1))
    view_from_camera = view.pose.inverse @ pose
    known = view.depth[view.depth > 0]
    if not len(known):
        return None
    depth = np.full(columns.shape, float(np.median(known)))
    at = np.zeros((*columns.shape, 2), np.float32)
    for _ in range(_STEPS + 1):
        points = view_from_camera.apply((rays * depth[..., None]).reshape(-1, 3))
        pixels = view.camera.project(points)[0].reshape(at.shape)
        at = np.nan_to_num(pixels, nan=_NOWHERE).astype(np.float32)
        found = cv2.remap(
            view.depth, at[..., 0] - 0.5, at[..., 1] - 0.5, cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        depth = np.where(found > 0, found, depth)
    at = _between_knots(at, half.width, half.height)
    return np.asarray(cv2.remap(view.rgb, at[..., 0] - 0.5, at[..., 1] - 0.5, cv2.INTER_LINEAR))


def _knots(size: int) -> np.ndarray:
    """A coordinate each `_GRID_PX` from the first pixel's centre to the last's or beyond."""
    return np.arange(-(-(size - 1) // _GRID_PX) + 1) * _GRID_PX + 0.5


def _between_knots(at: np.ndarray, width: int, height: int) -> np.ndarray:
    """Values at `_knots` (rows, columns, 2) for each pixel (height, width, 2), bilinear."""
    columns, rows = np.meshgrid(np.arange(width) / _GRID_PX, np.arange(height) / _GRID_PX)
    grid = (columns.astype(np.float32), rows.astype(np.float32))
    return np.asarray(cv2.remap(at, *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def footprint(picture: OverlayFrame) -> list[list[float]]:
    """Corners (east, north), m, of the ground in the view, without those in the sky; or []."""
    view = picture.view
    if view is None:
        return []
    height, width = view.depth.shape
    corners = [(0, 0), (width - 1, 0), (width - 1, height - 1), (0, height - 1)]
    known = [(c, r) for c, r in corners if view.depth[r, c] > 0]
    if not known:
        return []
    columns, rows = np.array(known).T
    points = _world(view, columns + 0.5, rows + 0.5, view.depth[rows, columns])
    return [[float(e), float(n)] for e, n, _ in points]


def _world(view: ReferenceImage, u: np.ndarray, v: np.ndarray, depth: np.ndarray) -> np.ndarray:
    rays = view.camera.rays(np.stack([u, v], axis=-1))
    return np.asarray(view.pose.apply(rays * depth[:, None].astype(np.float64)))


def _pose(data: dict[str, Any]) -> Pose:
    return Pose(matrix_from_quaternion(np.array(data["q"])), np.array(data["t"]))


def _jpeg(rgb: np.ndarray) -> bytes:
    _, data = cv2.imencode(
        ".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    )
    return data.tobytes()


_SIDE_PX = 256
_KEPT = 500
_MEMORY = 192 << 20  # of decoded map tiles
_LEAST_ZOOM, _MOST_ZOOM = 8, 22
_EQUATOR_M = 40_075_016.686
_TILE_QUALITY = 80


@dataclass(frozen=True)
class TileName:
    """Zoom and indices of a web map tile."""

    zoom: int
    x: int
    y: int

    @property
    def is_valid(self) -> bool:
        """Whether the tile exists, at a supported zoom."""
        if not _LEAST_ZOOM <= self.zoom <= _MOST_ZOOM:
            return False
        side = 1 << self.zoom  # of a checked zoom: an address could ask for gigabytes of it
        return 0 <= self.x < side and 0 <= self.y < side

    @property
    def centre(self) -> tuple[float, float]:
        """Latitude and longitude of the tile's centre, degrees."""
        side = 1 << self.zoom
        longitude = (self.x + 0.5) / side * 360.0 - 180.0
        latitude = math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * (self.y + 0.5) / side))))
        return latitude, longitude

    @property
    def side_m(self) -> float:
        """Side length of the tile on the ground, m."""
        return _EQUATOR_M * math.cos(math.radians(self.centre[0])) / (1 << self.zoom)


class TopTiles:
    """Renders tiles of the map seen from above, on demand, with a cache."""

    def __init__(self, map_path: Path) -> None:
        self._cache = TileCache.open(map_path)
        self._lock = threading.Lock()
        self._drawn = lru_cache(_KEPT)(self._draw)
        self._streamer: TileStreamer | None = None
        self._renderer: NumbaRenderer | None = None

    def map_position(self) -> dict[str, Any]:
        """Position of the map for the page. Across the 180th meridian, longitudes continue beyond
        180 degrees.
        """
        manifest, frame = self._cache.manifest, self._cache.frame
        low, high = self._cache.index.box_min[0], self._cache.index.box_max[0]
        ground, here = frame.origin.height_m, frame.origin.longitude_deg
        corners = [frame.position([e, n, 0.0]) for e, n in ((low[0], low[1]), (high[0], high[1]))]
        return {
            "bounds": [
                [lon_near(corner.longitude_deg, here), corner.latitude_deg] for corner in corners
            ],
            "origin": [frame.origin.latitude_deg, frame.origin.longitude_deg, ground],
            "outline": [[lon_near(lon, here), lat] for lat, lon in manifest.extent],
            "gsd_m": manifest.gsd_m,
            "attribution": manifest.attribution,
            "geoid_separation_m": manifest.geoid_separation_m,
        }

    def tile(self, name: TileName) -> bytes | None:
        """The tile as JPEG, rendered unless it is kept; None outside the map. Any thread."""
        if not name.is_valid:
            return None
        frame = self._cache.frame
        centre = frame.enu_from_geodetic(*name.centre, frame.origin.height_m)[:2]
        low, high = self._cache.index.box_min[0][:2], self._cache.index.box_max[0][:2]
        reach = name.side_m / 2
        if (centre + reach < low).any() or (centre - reach > high).any():
            return None
        with self._lock:
            return self._drawn(name)

    def close(self) -> None:
        """End the loader; no tile may be asked for any more."""
        if self._streamer is not None:
            self._streamer.close()

    def _draw(self, name: TileName) -> bytes:
        frame, bottom = self._cache.frame, float(self._cache.index.box_min[0, 2])
        centre = frame.enu_from_geodetic(*name.centre, frame.origin.height_m)[:2]
        scale = name.side_m / _SIDE_PX
        view = render_top_view(self._renderer_made(), centre, _SIDE_PX, scale, bottom)
        bgr = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _TILE_QUALITY])
        return data.tobytes()

    def _renderer_made(self) -> NumbaRenderer:
        if self._renderer is None:
            self._streamer = TileStreamer(self._cache, _MEMORY)
            self._renderer = NumbaRenderer(self._streamer, threads=1)
        return self._renderer
