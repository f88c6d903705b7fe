"""The map from above as web map tiles (z, x, y, web mercator)."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2

from localizer.geometry.antimeridian import lon_near
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import render_top_view

_SIDE_PX = 256
_KEPT = 500
_MEMORY = 192 << 20  # of decoded map tiles
_LEAST_ZOOM, _MOST_ZOOM = 8, 22
_EQUATOR_M = 40_075_016.686
_QUALITY = 80


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
        _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        return data.tobytes()

    def _renderer_made(self) -> NumbaRenderer:
        if self._renderer is None:
            self._streamer = TileStreamer(self._cache, _MEMORY)
            self._renderer = NumbaRenderer(self._streamer, threads=1)
        return self._renderer
