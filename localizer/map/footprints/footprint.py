"""Building footprints, and the reader of their files."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.plain_files import plain_text

MOST_BYTES = 512 << 20
_MOST = 500_000
_HIGHEST_M = 1000.0
_LONGEST = 300  # characters of an attribution


@dataclass(frozen=True, eq=False)
class Footprint:
    """A building. polygons: outline and holes of each, rings (N, 2) in the file's CRS, east or
    longitude first; height_m: of its highest point above the lowest ground under it.
    """

    polygons: tuple[tuple[Array, ...], ...]
    height_m: float


@dataclass(frozen=True)
class Footprints:
    """Buildings of a file. crs: as pyproj takes it; either_order: coordinates may be written north
    first; by_storeys: number with heights from storeys; left_out: number without height or area;
    attribution: as the file states.
    """

    path: Path
    crs: str
    buildings: tuple[Footprint, ...]
    either_order: bool = False
    by_storeys: int = 0
    left_out: int = 0
    attribution: str = ""

    def require(self) -> Footprints:
        """Returns itself; `MapSourceError` if it has no building, or too many."""
        if not self.buildings:
            raise MapSourceError(
                f"{self.path}: no building with a height ({self.left_out} without one): GeoJSON "
                "polygons need a property `height` in metres (or --height-property), CityGML a "
                "measuredHeight or solids"
            )
        if len(self.buildings) > _MOST:
            raise MapSourceError(f"{self.path}: over {_MOST} buildings: cut it to the map's area")
        return self


def ring_of(places: object) -> Array | None:
    """(N, 2) of a ring from its positions (x, y, and more), closed if it was open; None if it is
    invalid or has no area.
    """
    try:
        ring = np.array([[float(p[0]), float(p[1])] for p in places])  # type: ignore[attr-defined]
    except (TypeError, ValueError, IndexError, KeyError, OverflowError):
        return None
    if len(ring) < 3 or not np.isfinite(ring).all():
        return None
    if (ring[0] != ring[-1]).any():
        ring = np.concatenate([ring, ring[:1]])
    x, y = (ring - ring.mean(axis=0)).T
    area = 0.5 * abs(float(x[:-1] @ y[1:] - x[1:] @ y[:-1]))
    return ring if area > 0.0 else None


def one_line(text: object) -> str:
    """A file's text, printable, in one line of 300 characters at most; "" if it is no text."""
    if not isinstance(text, str):
        return ""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return " ".join(plain.split())[:_LONGEST]


def sane_height(value: object) -> float | None:
    """Metres of a number or of text such as "12.5 m"; None unless above 0 and up to 1000."""
    if isinstance(value, str):
        value = value.strip().removesuffix("m").strip()
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        return None
    try:
        metres = float(value)
    except ValueError:
        return None
    return metres if math.isfinite(metres) and 0.0 < metres <= _HIGHEST_M else None


HEIGHTS = ("height", "building:height", "measuredHeight", "measured_height", "HEIGHT", "Height")
_STOREYS = ("building:levels", "num_floors", "levels", "storeysAboveGround")
_STOREY_M = 3.0
# Members of the collection: Overpass writes the first, exports of cadastres the others.
_WHOSE = ("copyright", "attribution", "licence", "license")


def read_geojson(path: Path, height_property: str | None = None) -> Footprints:
    """Polygons with a height, otherwise with storeys of 3 m. height_property: name of the height's
    property; None: the usual ones. `MapSourceError` for another file.
    """
    try:
        document = json.loads(plain_text(path, MOST_BYTES))
        features = document["features"]
        crs = _crs(document)
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise MapSourceError(f"{path}: no GeoJSON FeatureCollection: {error}") from error
    names = HEIGHTS if height_property is None else (height_property,)
    storeys = _STOREYS if height_property is None else ()
    found: list[Footprint] = []
    by_storeys = left_out = 0
    for feature in features:
        said = feature.get("properties") if isinstance(feature, dict) else None
        said = said if isinstance(said, dict) else {}
        height = _first(said, names)
        if height is None and (floors := _first(said, storeys)) is not None:
            height, by_storeys = floors * _STOREY_M, by_storeys + 1
        outlines = list(_outlines(feature))
        if height is None or not outlines:
            left_out += 1
            continue
        found.append(Footprint(tuple(outlines), height))
    whose = "; ".join(dict.fromkeys(filter(None, (one_line(document.get(k)) for k in _WHOSE))))
    return Footprints(
        path, crs, tuple(found), by_storeys=by_storeys, left_out=left_out, attribution=whose
    ).require()


def _crs(document: dict[str, Any]) -> str:
    """WGS84, or what a file from before RFC 7946 names."""
    named = document.get("crs") or {}
    name = named.get("properties", {}).get("name")
    return "OGC:CRS84" if name is None else str(name)


def _first(said: dict[str, Any], names: tuple[str, ...]) -> float | None:
    return next((h for name in names if (h := sane_height(said.get(name))) is not None), None)


def _outlines(feature: Any) -> Iterator[tuple[Array, ...]]:
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if not isinstance(geometry, dict):
        return
    kind, places = geometry.get("type"), geometry.get("coordinates")
    if not isinstance(places, list):
        return
    for polygon in places if kind == "MultiPolygon" else [places] if kind == "Polygon" else []:
        rings = [ring_of(ring) for ring in polygon] if isinstance(polygon, list) else []
        if rings and rings[0] is not None:
            yield tuple(ring for ring in rings if ring is not None)
