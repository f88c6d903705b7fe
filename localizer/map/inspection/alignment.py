"""A map's mosaic from above: its usable part, and the imagery's offset from the surface."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.geo import GeoBox, LocalFrame, lon_near, wrapped
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import render_top_view
from localizer.types import Float32, Image

_SQUARE_PX = 512
_MOST_PX = 12_000_000
_FINEST_M = 0.25  # per pixel


@dataclass(frozen=True)
class Mosaic:
    """The map from above, north up. rgb: (h, w, 3), holes filled; height: (h, w) float32 world z,
    NaN without map; west, north: of its corner, m; gsd_m: metres per pixel.
    """

    rgb: Image
    height: Float32
    west: float
    north: float
    gsd_m: float

    def place(self, row: float, column: float) -> tuple[float, float]:
        """(east, north) m of a pixel's corner."""
        return self.west + column * self.gsd_m, self.north - row * self.gsd_m

    def pixel(self, east: float, north: float) -> tuple[float, float]:
        """(row, column) of a position (world metres)."""
        return (self.north - north) / self.gsd_m, (east - self.west) / self.gsd_m


def render_mosaic(cache: TileCache, most_px: int = _MOST_PX) -> Mosaic:
    """Render the map's bounding rectangle at its resolution, at most `most_px`. `MapCacheError` for
    a tile that cannot be read.
    """
    low, high = cache.index.box_min[0], cache.index.box_max[0]
    extent = (high - low)[:2]
    finest = max(cache.manifest.gsd_m, _FINEST_M)
    gsd = max(finest, float(np.sqrt(np.prod(extent) / most_px)))
    columns, rows = (max(int(np.ceil(side / gsd)), 1) for side in extent)
    rgb = np.zeros((rows, columns, 3), np.uint8)
    height = np.full((rows, columns), np.nan, np.float32)
    west, north = float(low[0]), float(high[1])
    with TileStreamer(cache) as streamer:
        renderer = NumbaRenderer(streamer, 1)
        try:
            for top in range(0, rows, _SQUARE_PX):
                for left in range(0, columns, _SQUARE_PX):
                    half = _SQUARE_PX / 2 * gsd
                    centre: Array = np.array([west + left * gsd + half, north - top * gsd - half])
                    view = render_top_view(renderer, centre, _SQUARE_PX, gsd, float(low[2]))
                    part = (slice(top, top + _SQUARE_PX), slice(left, left + _SQUARE_PX))
                    h, w = rgb[part].shape[:2]
                    rgb[part], height[part] = view.rgb[:h, :w], view.height[:h, :w]
        finally:
            renderer.close()
    return Mosaic(rgb, height, west, north, gsd)


_CELL_M = 0.5  # at which edges are compared
_REACH_M = 10.0  # of the shifts that are tried
_STEP_M = 1.5  # of the surface, within a cell or two: walls, crowns
_SMOOTH_M = 1.0
_DARK = 10.0  # grey value below which colour is noise
_LEAST_COLOUR = 1e-3  # of the strongest edges of colour
_LEAST_EDGES = 400  # cells with a step; with fewer nothing can be said
_LEAST_PEAK = 4.0  # of the best shift's correlation over the others', in their deviations


@dataclass(frozen=True)
class ImageryOffset:
    """Offset between imagery and surface. east_m, north_m: offset of the imagery from the surface;
    peak: its significance, in standard deviations; edges: number of cells of the surface with a
    step. known: whether it is significant.
    """

    east_m: float
    north_m: float
    peak: float
    edges: int

    @property
    def known(self) -> bool:
        """Whether there are enough edges and one significant offset."""
        return self.edges >= _LEAST_EDGES and self.peak >= _LEAST_PEAK

    @property
    def distance_m(self) -> float:
        """Length of the offset."""
        return float(np.hypot(self.east_m, self.north_m))


def measure_alignment(mosaic: Mosaic) -> ImageryOffset:
    """The offset at which the imagery's edges match the surface's steps best.

    Accurate to about a metre: walls that lean in the image bias it. Unknown without colours.
    """
    scale = mosaic.gsd_m / _CELL_M
    size = (round(mosaic.rgb.shape[1] * scale), round(mosaic.rgb.shape[0] * scale))
    rgb = cv2.resize(mosaic.rgb, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    gaps = cv2.resize(np.isnan(mosaic.height).astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    low = float(np.nanmin(mosaic.height)) if np.isfinite(mosaic.height).any() else 0.0
    heights = cv2.resize(np.nan_to_num(mosaic.height, nan=low), size, interpolation=cv2.INTER_AREA)
    reach = round(_REACH_M / _CELL_M)
    inner = cv2.erode(1 - (gaps > 0).astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8))
    steps = _gradient(heights) > _STEP_M
    steps &= inner > 0
    edges = int(steps.sum())
    if edges < _LEAST_EDGES or min(size) <= 4 * reach:
        return ImageryOffset(0.0, 0.0, 0.0, edges)
    picture = _colour_edges(rgb)
    if float(np.percentile(picture, 97)) < _LEAST_COLOUR:
        return ImageryOffset(0.0, 0.0, 0.0, edges)
    picture = np.minimum(picture, np.percentile(picture, 97)) - cv2.blur(picture, (41, 41))
    surface = steps.astype(np.float32) - cv2.blur(steps.astype(np.float32), (41, 41))
    core = surface[reach:-reach, reach:-reach]
    match = cv2.matchTemplate(
        np.ascontiguousarray(picture, np.float32), np.ascontiguousarray(core), cv2.TM_CCORR
    )
    row, column = np.unravel_index(int(match.argmax()), match.shape)
    far = np.hypot(*(np.indices(match.shape) - np.reshape((row, column), (2, 1, 1)))) > 6
    peak = float((match[row, column] - match[far].mean()) / max(float(match[far].std()), 1e-9))
    dx, dy = _between(match, int(row), int(column))
    return ImageryOffset((dx - reach) * _CELL_M, -(dy - reach) * _CELL_M, peak, edges)


def _colour_edges(rgb: Float32) -> Float32:
    """Gradient (h, w) of the colour without its brightness. Shadows change the brightness only, and
    all fall to one side, so their edges would bias the offset.
    """
    smooth = cv2.GaussianBlur(rgb, (0, 0), _SMOOTH_M / _CELL_M)
    chroma = (smooth + _DARK) / (smooth.sum(axis=2, keepdims=True) + 3 * _DARK)
    parts = [_gradient(np.ascontiguousarray(chroma[..., k])) for k in range(3)]
    return np.asarray(np.sum(parts, axis=0), np.float32)


def _gradient(image: Float32) -> Float32:
    dx, dy = (cv2.Sobel(image, cv2.CV_32F, *axis, scale=0.125) for axis in ((1, 0), (0, 1)))
    return np.asarray(np.hypot(dx, dy), np.float32)


def _between(match: Float32, row: int, column: int) -> tuple[float, float]:
    """Column and row of the peak by a parabola through its neighbours."""
    found = []
    for at, line in ((column, match[row]), (row, match[:, column])):
        offset = 0.0
        if 0 < at < len(line) - 1:
            a, b, c = (float(v) for v in line[at - 1 : at + 2])
            bend = a - 2 * b + c
            offset = 0.5 * (a - c) / bend if bend < 0 else 0.0
        found.append(at + offset)
    return found[0], found[1]


_CELL_OF_HEIGHT = 1 / 8  # a hole of a tenth of such a cell takes nothing from a view
_MOST_CELLS = 400  # a side
_LEAST_GOOD = 0.9  # of a cell
_RIM = 2  # cells of both sides: a ragged edge is no news


@dataclass(frozen=True)
class UsableArea:
    """The largest rectangle without faults. box: inside it; size_m: east and north; is_whole: it
    covers the map except for a margin of one cell.
    """

    box: GeoBox
    size_m: tuple[float, float]
    is_whole: bool

    def line(self) -> str:
        """The area as text."""
        east_m, north_m = self.size_m
        return f"{self.box.line()} ({east_m:.0f} x {north_m:.0f} m)"


def usable_part(
    mosaic: Mosaic, faulty: NDArray[np.bool_], height_m: float, frame: LocalFrame
) -> UsableArea | None:
    """The largest rectangle of cells that are 90 % free of faults; None without any.

    faulty: (h, w), True where the mosaic has nothing to match. height_m: of the flight; sets the
    size of the cells. frame: of the mosaic's metres.
    """
    rows, columns = faulty.shape
    cell = max(round(height_m * _CELL_OF_HEIGHT / mosaic.gsd_m), 1)
    cell = max(min(cell, min(rows, columns) // 8), -(-max(rows, columns) // _MOST_CELLS), 1)
    h, w = max(rows // cell, 1), max(columns // cell, 1)
    share = cv2.resize(faulty.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    found = largest_rectangle(share <= 1 - _LEAST_GOOD)
    if found is None:
        return None
    top, bottom = (r * rows / h for r in found[:2])
    left, right = (c * columns / w for c in found[2:])
    corners = [mosaic.place(r, c) for r in (top, bottom) for c in (left, right)]
    places = [frame.position(np.array([*corner, 0.0])) for corner in corners]
    north_west, north_east, south_west, south_east = (p.latitude_deg for p in places)
    about = frame.origin.longitude_deg
    beyond = [lon_near(p.longitude_deg, about) for p in places]  # in the same order
    return UsableArea(
        GeoBox(
            max(south_west, south_east),
            wrapped(max(beyond[0], beyond[2])),
            min(north_west, north_east),
            wrapped(min(beyond[1], beyond[3])),
        ),
        ((right - left) * mosaic.gsd_m, (bottom - top) * mosaic.gsd_m),
        found[1] - found[0] >= h - _RIM and found[3] - found[2] >= w - _RIM,
    )


def largest_rectangle(good: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """(first row, end row, first column, end column) of the largest all-true rectangle, or None."""
    best, found = 0, None
    above = np.zeros(good.shape[1], np.int64)
    for row, line in enumerate(good):
        above = np.where(line, above + 1, 0)
        waiting: list[tuple[int, int]] = []  # first column and height, rising
        for column, height in enumerate([*above.tolist(), 0]):
            first = column
            while waiting and waiting[-1][1] >= height:
                first, high = waiting.pop()
                if high * (column - first) > best:
                    best = high * (column - first)
                    found = (row + 1 - high, row + 1, first, column)
            waiting.append((first, height))
    return found
