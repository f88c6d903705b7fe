"""Reads footprints of a GeoJSON file (RFC 7946) with properties of OpenStreetMap or cadastres."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.footprints.footprint import (
    MOST_BYTES,
    Footprint,
    Footprints,
    one_line,
    ring_of,
    sane_height,
)
from localizer.plain_files import plain_text

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
