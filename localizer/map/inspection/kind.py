"""Measures the kind of map in a tile cache, from vertical views."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.geo import EARTH_RADIUS_M
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.map.kind import RESOLUTION_M, UNKNOWN_HEIGHT_SIGMA_M, Heights, MapKind
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import TopView, render_top_view
from localizer.types import Float32

_CELL_M, _CELLS = 1.0, 256  # of a square of heights
_SQUARES = 9
_WINDOW_CELLS = 61  # wider than most buildings: what an opening of this size takes off stands up
_LEAST_RISE_M = 2.0  # of a wall, over two cells
_LEAST_CELLS = 16  # of a building or a crown
_WALLED = 0.5  # of an object's border; a hill's is not
_LEAST_STANDING = 0.002  # of the ground: one farmhouse in 6 hectares
_FLAT_M = 0.1  # deviation from a plane that no measured ground keeps

_TEXELS, _LEAST_TEXELS = 256, 32  # of a square of imagery; half a texel a pixel
_IMAGES = 12
_KNOWN = 0.98  # of a square of imagery
_BANDS = 32  # of the spectrum, up to the texels' limit of half a cycle a texel
# Natural ground's power falls as frequency to the power of -2.5; where it lies 100 times below
# that, the imagery keeps a tenth of the contrast: the usual limit of resolution.
_SLOPE, _LOST = 2.5, 100.0
# Noise: the power hardly falls any more from here to the texels' limit; over the last half octave
# natural ground falls as little.
_FLAT_FALL, _FLAT_UP_TO = 1.3, 0.3
_PALETTE_M = 0.25  # a pixel, of maps without textures


def map_kind(cache: TileCache) -> MapKind:
    """The map's kind from the manifest; measured now (seconds) if an older build has none."""
    found = cache.manifest.kind
    return found or measure_kind(cache, imagery_date=cache.manifest.imagery_date)


def measure_kind(
    cache: TileCache,
    *,
    heights: Heights | None = None,
    imagery_date: str | None = None,
    sensor: str | None = None,
) -> MapKind:
    """Measure the kind from vertical views of samples. heights: given by the user; None: measured.
    imagery_date, sensor: stored as given.
    """
    with TileStreamer(cache) as streamer:
        renderer = NumbaRenderer(streamer, 1)
        try:
            found = heights or _heights(cache, renderer)
            resolution = _resolution(cache, renderer)
        finally:
            renderer.close()
    resolution = round(float(np.clip(resolution, *RESOLUTION_M)), 4)
    return MapKind(found, UNKNOWN_HEIGHT_SIGMA_M[found], resolution, imagery_date, sensor)


def _views(
    cache: TileCache, renderer: NumbaRenderer, count: int, side_px: int, gsd_m: float
) -> Iterator[tuple[Array, TopView]]:
    """Vertical views of squares about the centres of leaves, spread over the map: the centre (2,),
    east and north m, of each square, and its view.
    """
    index = cache.index
    spread = np.linspace(0, len(index.leaves) - 1, min(count, len(index.leaves)))
    base_m = float(index.box_min[0, 2])
    for leaf in index.leaves[spread.round().astype(int)]:
        centre: Array = 0.5 * (index.box_min[leaf] + index.box_max[leaf])[:2]
        yield centre, render_top_view(renderer, centre, side_px, gsd_m, base_m)


def _heights(cache: TileCache, renderer: NumbaRenderer) -> Heights:
    points, standing, known = [], 0, 0
    for centre, view in _views(cache, renderer, _SQUARES, _CELLS, _CELL_M):
        shown = np.isfinite(view.height)
        standing += int(object_mask(view.height, _CELL_M).sum())
        known += int(shown.sum())
        rows, columns = (cells[::37] for cells in np.nonzero(shown))
        east = centre[0] + (columns + 0.5 - _CELLS / 2) * _CELL_M
        north = centre[1] - (rows + 0.5 - _CELLS / 2) * _CELL_M
        points.append(np.stack([east, north, view.height[rows, columns]], axis=1))
    if standing > _LEAST_STANDING * known:
        return "surface"
    return "flat" if not points or _from_plane_m(np.concatenate(points)) < _FLAT_M else "terrain"


def object_mask(height: Float32, cell_m: float) -> NDArray[np.bool_]:
    """Cells of a height grid (h, w), NaN where unknown, that belong to buildings or trees: narrower
    than 60 m, higher than 2 m, most of the border steep.
    """
    known = np.isfinite(height)
    if not known.any():
        return known
    low, high = height[known].min(), height[known].max()
    window = round(_WINDOW_CELLS * _CELL_M / cell_m) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (window, window))
    filled = np.where(known, height, high).astype(np.float32)
    above = (filled - cv2.morphologyEx(filled, cv2.MORPH_OPEN, disc) > _LEAST_RISE_M) & known
    near = np.ones((3, 3), np.uint8)
    rise = cv2.dilate(np.where(known, filled, low), near) - cv2.erode(filled, near)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(above.astype(np.uint8))
    border = above & (cv2.erode(above.astype(np.uint8), near) == 0)
    around = np.bincount(labels[border], minlength=count)
    walls = np.bincount(labels[border & (rise > _LEAST_RISE_M)], minlength=count)
    is_object = (walls > _WALLED * around) & (stats[:, cv2.CC_STAT_AREA] >= _LEAST_CELLS)
    is_object[0] = False
    return np.asarray(is_object[labels])


def _from_plane_m(points: Array) -> float:
    """Deviation of points (N, 3) from a plane that follows the Earth's curve."""
    level = points[:, 2] + (points[:, :2] ** 2).sum(axis=1) / (2 * EARTH_RADIUS_M)
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    return float(np.std(level - design @ np.linalg.lstsq(design, level, rcond=None)[0]))


def _resolution(cache: TileCache, renderer: NumbaRenderer) -> float:
    """Resolution of the imagery (m); the texel size if it cannot be measured."""
    texel_m = cache.manifest.gsd_m or _PALETTE_M
    low, high = cache.index.box_min[0], cache.index.box_max[0]
    room = float((high - low)[:2].min()) / texel_m
    texels = max(min(_TEXELS, 2 ** int(np.log2(max(room, 1.0)))), _LEAST_TEXELS)
    spectra = []
    for _, view in _views(cache, renderer, _IMAGES, 2 * texels, texel_m / 2):
        if np.isfinite(view.height).mean() >= _KNOWN:
            grey = view.rgb.mean(axis=2, dtype=np.float32)
            if grey.std() > 2.0:
                spectra.append(_spectrum(grey))
    return texel_m / (2 * resolution_limit(np.median(spectra, axis=0))) if spectra else texel_m


def _spectrum(grey: Float32) -> Array:
    """Power (bands,) by frequency of an image (n, n) with half a texel per pixel."""
    n = len(grey)
    taper = np.hanning(n)[:, None] * np.hanning(n)
    power = np.abs(np.fft.fft2((grey - grey.mean()) * taper)) ** 2
    cycles = 2 * np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))  # a texel
    band = (cycles * 2 * _BANDS).astype(int)
    inside = band < _BANDS
    sums = np.bincount(band[inside], power[inside], _BANDS)
    mean: Array = sums / np.maximum(np.bincount(band[inside], minlength=_BANDS), 1)
    return mean / np.sinc(_frequencies()) ** 4  # what drawing between texels took away


def _frequencies() -> Array:
    return (np.arange(_BANDS) + 0.5) / (2 * _BANDS)


def resolution_limit(power: Array) -> float:
    """Spatial frequency, cycles a texel up to 0.5, above which an image with this spectrum has no
    detail.

    power: (_BANDS,) at equally wide bands of frequency up to half a cycle a texel.
    """
    frequency = _frequencies()
    whitened = power * frequency**_SLOPE
    beyond = np.array([np.median(power[band:]) for band in range(len(power))])
    noise = (power < _FLAT_FALL * beyond) & (frequency < _FLAT_UP_TO)
    limit = 0.5
    for _ in range(5):  # the level is taken where the imagery still shows everything
        level = np.quantile(whitened[frequency < max(limit / 2, 3 / (2 * _BANDS))], 0.75)
        lost = np.flatnonzero((whitened < level / _LOST) | noise)
        limit = float(frequency[lost[0]]) if len(lost) else 0.5
    return limit
