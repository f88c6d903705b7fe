"""A map's outline as GeoJSON (RFC 7946) and KML 2.2."""

from __future__ import annotations

import json
from typing import Any
from xml.sax.saxutils import escape

from localizer.geometry.antimeridian import Corner, split_outline
from localizer.map.cache.cache import Manifest


def as_geojson(manifest: Manifest, name: str) -> str:
    """GeoJSON text with one feature: the map's outline as a polygon, counter-clockwise, longitude
    first. An outline across the 180th meridian becomes two polygons. name: a property of it.
    """
    rings = _rings(manifest)
    geometry: dict[str, Any] = {"type": "Polygon", "coordinates": rings}
    if len(rings) > 1:
        geometry = {"type": "MultiPolygon", "coordinates": [[ring] for ring in rings]}
    feature = {
        "type": "Feature",
        "geometry": geometry,
        "properties": {
            "name": name,
            "attribution": manifest.attribution,
            "gsd_m": manifest.gsd_m,
            "lowest_m": manifest.height_range_m[0],
            "highest_m": manifest.height_range_m[1],
            "geoid_separation_m": manifest.geoid_separation_m,
        },
    }
    return json.dumps({"type": "FeatureCollection", "features": [feature]}, indent=1) + "\n"


def as_kml(manifest: Manifest, name: str) -> str:
    """One placemark: the outline as a polygon on the ground, or as two, as in GeoJSON."""
    polygons = "".join(
        "<Polygon><outerBoundaryIs><LinearRing><coordinates>"
        + " ".join(f"{lon:.8f},{lat:.8f}" for lon, lat in ring)
        + "</coordinates></LinearRing></outerBoundaryIs></Polygon>"
        for ring in _rings(manifest)
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
        f"<name>{escape(name)}</name><description>{escape(manifest.attribution)}</description>"
        f"<MultiGeometry>{polygons}</MultiGeometry>"
        "</Placemark></Document></kml>\n"
    )


def _rings(manifest: Manifest) -> list[list[Corner]]:
    """(longitude, latitude) corners, counter-clockwise, the first again at the end."""
    return [_closed(ring) for ring in split_outline([(lon, lat) for lat, lon in manifest.extent])]


def _closed(corners: list[Corner]) -> list[Corner]:
    following = [*corners[1:], corners[0]]
    area = sum(x * b - a * y for (x, y), (a, b) in zip(corners, following, strict=True))
    if area < 0:
        corners = corners[::-1]
    return [*corners, corners[0]]
