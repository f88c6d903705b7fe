"""A map's outline for other programs: GeoJSON (RFC 7946) and KML 2.2."""

from __future__ import annotations

import json
from xml.sax.saxutils import escape

from localizer.map.cache.cache import Manifest


def as_geojson(manifest: Manifest, name: str) -> str:
    """One feature: the outline as a polygon, counter-clockwise, longitude first."""
    feature = {
        "type": "Feature",
        "geometry": {"type": "Polygon", "coordinates": [_ring(manifest)]},
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
    """One placemark: the outline as a polygon on the ground."""
    ring = " ".join(f"{lon:.8f},{lat:.8f}" for lon, lat in _ring(manifest))
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
        f"<name>{escape(name)}</name><description>{escape(manifest.attribution)}</description>"
        "<Polygon><outerBoundaryIs><LinearRing><coordinates>"
        f"{ring}</coordinates></LinearRing></outerBoundaryIs></Polygon>"
        "</Placemark></Document></kml>\n"
    )


def _ring(manifest: Manifest) -> list[tuple[float, float]]:
    """(longitude, latitude) corners, counter-clockwise, the first again at the end."""
    corners = [(lon, lat) for lat, lon in manifest.extent]
    following = [*corners[1:], corners[0]]
    area = sum(x * b - a * y for (x, y), (a, b) in zip(corners, following, strict=True))
    if area < 0:
        corners.reverse()
    return [*corners, corners[0]]
