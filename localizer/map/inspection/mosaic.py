"""Image and heights of a whole map from above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
