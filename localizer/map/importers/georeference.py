"""Position on Earth of a mesh without coordinates."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from localizer.errors import GeoreferenceError
from localizer.geometry.geo import Geodetic, LocalFrame, ecef_from_geodetic
from localizer.geometry.pose import Array, so3_exp
from localizer.map.importers.height_crs import horizontal_unit_m, place_doubts
from localizer.map.importers.rules import ImportRules
from localizer.plain_files import load_json, plain_text

UpAxis = Literal["y", "z"]


@dataclass(frozen=True)
class Georeference:
    """Either a projected CRS (WKT) and the offset (easting, northing, height) that is added to the
    vertices, or an ENU origin and the heading of the mesh's y axis, clockwise from north.
    unread: keys of its file that mean nothing here.
    """

    crs: str | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    origin: Geodetic | None = None
    heading_deg: float = 0.0
    unread: tuple[str, ...] = ()

    def ecef(self, points: Array) -> Array:
        """ECEF (N, 3) of the mesh's points (N, 3), z up, metres. `GeoreferenceError` without a CRS
        or an origin.
        """
        if self.crs is not None:
            return ecef_from_crs(self.crs, points + np.array(self.offset))
        if self.origin is None:
            raise GeoreferenceError("a georeference needs a CRS or an origin")
        turn = so3_exp([0.0, 0.0, -np.radians(self.heading_deg)])
        return LocalFrame(self.origin).ecef_from_enu.apply(points @ turn.T)

    def doubts(self, points: Array, source: Path, rules: ImportRules) -> list[str]:
        """Warnings about the place of a mesh with points (N, 3), see `height_crs.place_doubts`."""
        if self.crs is None:
            return []
        placed = points + np.array(self.offset)
        lon, lat = _geographic(self.crs).transform(placed[:, 0], placed[:, 1])
        if not np.isfinite(lon).all():
            return []  # an error where it is placed
        return place_doubts(CRS(self.crs), np.asarray(lon), np.asarray(lat), source, rules)


def read_georeference(path: Path) -> Georeference:
    """Read OpenDroneMap's offset file (``WGS84 UTM 29N`` and ``easting northing``), or JSON:
    ``{"origin": {"lat": ..., "lon": ..., "height": ...}, "heading_deg": 0}`` or ``{"epsg": 32629,
    "offset": [easting, northing, height]}``. `GeoreferenceError` if the file cannot be read or is
    neither.
    """
    try:
        text = plain_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise GeoreferenceError(f"{path}: cannot be read: {error}") from error
    try:
        if text.lstrip().startswith("{"):
            return _from_json(load_json(text))
        return _from_odm(text)
    except (
        ValueError, TypeError, KeyError, AttributeError, CRSError, GeoreferenceError, RecursionError
    ) as error:  # fmt: skip
        raise GeoreferenceError(f"{path}: not a georeference: {error!r}") from error


def _unread(data: dict[str, Any], known: set[str]) -> tuple[str, ...]:
    """Keys of a file that are not read, for example a remark, or a scale that is not applied."""
    return tuple(sorted(set(data) - known))


def _from_json(data: dict[str, Any]) -> Georeference:
    if "epsg" in data:
        x, y, z = (float(v) for v in data["offset"])
        crs = CRS.from_epsg(int(data["epsg"]))
        if not crs.is_projected:
            raise ValueError(f"EPSG:{data['epsg']} is not a projected CRS")
        if horizontal_unit_m(crs) != 1.0:
            raise ValueError(f"EPSG:{data['epsg']} is in feet: a mesh must be in metres")
        unread = _unread(data, {"epsg", "offset"})
        return Georeference(crs.to_2d().to_wkt(), (x, y, z), unread=unread)
    o = data["origin"]
    unread = _unread(data, {"origin", "heading_deg"}) + _unread(o, {"lat", "lon", "height"})
    origin = Geodetic(float(o["lat"]), float(o["lon"]), float(o["height"]))
    heading_deg = float(data.get("heading_deg", 0.0))
    if not math.isfinite(heading_deg):
        raise ValueError(f"heading_deg is {heading_deg}")
    return Georeference(origin=origin, heading_deg=heading_deg, unread=unread)


def _from_odm(text: str) -> Georeference:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if len(lines) < 2:
        raise ValueError("two lines were expected: the UTM zone, and easting and northing")
    zone = re.fullmatch(r"WGS84 UTM (\d{1,2})([NS])", lines[0], re.IGNORECASE)
    if zone is None or not 1 <= int(zone[1]) <= 60:
        raise ValueError(f"{lines[0]!r} is not a zone like 'WGS84 UTM 29N'")
    base = 32600 if zone[2].upper() == "N" else 32700
    east, north = (float(v) for v in lines[1].split()[:2])
    return Georeference(CRS.from_epsg(base + int(zone[1])).to_wkt(), (east, north, 0.0))


@lru_cache(maxsize=4)
def _geographic(crs: str) -> Transformer:
    return Transformer.from_crs(CRS(crs).to_2d(), CRS("EPSG:4326"), always_xy=True)


def ecef_from_crs(crs: str, points: Array) -> Array:
    """ECEF (N, 3) of a CRS's eastings, northings and ellipsoidal heights (N, 3).
    `GeoreferenceError` for coordinates outside the CRS's area.
    """
    lon, lat = _geographic(crs).transform(points[:, 0], points[:, 1])
    if not np.isfinite(lon).all():
        raise GeoreferenceError("coordinates outside the area where their CRS is defined")
    return ecef_from_geodetic(lat, lon, points[:, 2])
