"""Checks whether a map is the one of a record; it may have been built again since."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.errors import ConfigError, RecordError
from companion.preflight.map_pin import map_hash
from localizer.geometry.geo import Geodetic
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache

_SAME_FRAME_M = 1.0


@dataclass(frozen=True)
class FlownMap:
    """A record's data about its map. sha256: hash of the map's manifest, None in old records.
    place, point: one pose in WGS84 and in the map's ENU, m; None if not recorded.
    """

    folder: Path
    sha256: str | None = None
    place: Geodetic | None = None
    point: Array | None = None

    def require_frame(self, cache: TileCache) -> None:
        """`RecordError` if the map's origin is not the flight's, because all recorded positions
        would be shifted.
        """
        if self.place is None or self.point is None:
            return
        p = self.place
        here = cache.frame.enu_from_geodetic(p.latitude_deg, p.longitude_deg, p.height_m)
        away_m = float(np.linalg.norm(here - self.point))
        if away_m > _SAME_FRAME_M:
            raise RecordError(
                f"{self.folder}: flown over a map about another origin than {cache.path}, "
                f"{away_m:.0f} m away: was it built again since? give the flight's own as --map"
            )

    def mismatch(self, cache: TileCache) -> str:
        """A warning if the map's hash is not the flown one's; "" if it is, or none was recorded."""
        try:
            same = self.sha256 in (None, map_hash(cache.path))
        except ConfigError as error:
            return str(error)
        if same:
            return ""
        return (
            f"{cache.path} is not the map that was flown over: was it built again since? what "
            "differs from the flight may be the map's"
        )
