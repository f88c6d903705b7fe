"""Building footprints and the readers of their files: GeoJSON, CityGML 1.0 to 3.0 (OGC 20-010)."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.importers.height_crs import UNITS, horizontal_unit_m
from localizer.plain_files import plain_bytes, plain_text

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


# As CityGML spells them besides: UCUM, EPSG's numbers, English plurals.
_UNITS = {
    "mtr": 1.0, "meters": 1.0, "9001": 1.0, "ft_i": UNITS["ft"], "9002": UNITS["ft"],
    "ft_us": UNITS["us-ft"], "9003": UNITS["us-ft"],
}  # fmt: skip
_BUILDINGS = ("Building", "BuildingPart")
_GROUNDS = ("GroundSurface", "lod0FootPrint")
_LEVEL_M = 0.3  # by which a ground surface's corners may differ in height
_EPSG = re.compile(r"EPSG[:/]+(?:[\d.]*[:/])?(\d{4,6})", re.IGNORECASE)
_ADV = re.compile(r"ETRS89_UTM(\d\d)")  # Germany's surveys


def read_citygml(path: Path) -> Footprints:
    """Read the buildings of a CityGML file with their heights in metres: measuredHeight, otherwise
    the height of their solids. Buildings without a height are counted in `left_out`.
    `MapSourceError` if the file cannot be read or holds no usable building.
    """
    try:
        data = plain_bytes(path, MOST_BYTES)
        if b"<!ENTITY" in data or b"<!DOCTYPE" in data:
            raise MapSourceError(f"{path}: brings a document type of its own: no CityGML does")
        root = ElementTree.fromstring(data)
    except (OSError, ElementTree.ParseError) as error:
        raise MapSourceError(f"{path}: no CityGML: {error}") from error
    found: list[Footprint] = []
    left_out = 0
    buildings = [element for element in root.iter() if _name(element) in _BUILDINGS]
    crs = _gml_crs(path, root) if buildings else ""
    try:
        unit_m = horizontal_unit_m(CRS(crs)) if crs else 1.0
    except CRSError as error:
        raise MapSourceError(f"{path}: {error}") from error
    for element in buildings:
        made = _footprint(element, path, unit_m)
        if made is not None:
            found.append(made)
        elif not any(_name(part) == "BuildingPart" for part in element.iter()):
            left_out += 1
    return Footprints(path, crs, tuple(found), either_order=True, left_out=left_out).require()


def _name(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _gml_crs(path: Path, root: ElementTree.Element) -> str:
    told = [e.attrib["srsName"] for e in root.iter() if "srsName" in e.attrib]
    for name in told:
        if match := _EPSG.search(name):
            return f"EPSG:{match[1]}"
        if match := _ADV.search(name):
            return f"EPSG:258{match[1]}"
    raise MapSourceError(f"{path}: says no CRS that is known ({', '.join(told[:3]) or 'none'})")


def _own(element: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """The elements of a building without those of its parts."""
    for child in element:
        if _name(child) not in _BUILDINGS:
            yield child
            yield from _own(child)


def _measured(element: ElementTree.Element, path: Path) -> float | None:
    """measuredHeight in metres; None without one. Its unit is a name, or the end of a URL."""
    uom = element.attrib.get("uom", "m")
    name = re.split(r"[:#/]", uom)[-1].strip("[]").lower()
    unit_m = UNITS.get(name, _UNITS.get(name))
    if unit_m is None:
        raise MapSourceError(f"{path}: a measuredHeight has the unit {uom!r}: m or ft is expected")
    told = sane_height(element.text or "")
    return None if told is None else told * unit_m


def _footprint(building: ElementTree.Element, path: Path, unit_m: float) -> Footprint | None:
    """A building's footprint; None without height or area. unit_m: metres per unit of the file."""
    told: float | None = None
    for element in _own(building):
        if _name(element) == "measuredHeight":
            told = _measured(element, path)
    grounds = [e for e in _own(building) if _name(e) in _GROUNDS]
    everything = list(_polygons(building))
    height = told
    if height is None and everything:
        heights = np.concatenate([p[0][:, 2] for p in everything])
        height = sane_height(unit_m * float(np.ptp(heights)))
    if height is None or not everything:
        return None
    ground = [p for e in grounds for p in _polygons(e)]
    if not ground:  # of a solid the level surface at its foot
        lowest = min(float(p[0][:, 2].min()) for p in everything)
        ground = [p for p in everything if float(p[0][:, 2].max()) < lowest + _LEVEL_M]
    outlines = []
    for polygon in ground:
        rings = [ring_of(ring[:, :2]) for ring in polygon]
        if rings[0] is not None:
            outlines.append(tuple(ring for ring in rings if ring is not None))
    return Footprint(tuple(outlines), height) if outlines else None


def _polygons(element: ElementTree.Element) -> Iterator[list[Array]]:
    """Rings (N, 3) of each polygon, the outline first."""
    for polygon in (e for e in _own(element) if _name(e) == "Polygon"):
        rings = []
        for ring in (e for e in polygon.iter() if _name(e) == "LinearRing"):
            text = " ".join(e.text or "" for e in ring.iter() if _name(e) in ("posList", "pos"))
            try:
                numbers = np.array(text.split(), np.float64)
            except ValueError:
                continue
            if len(numbers) >= 9 and len(numbers) % 3 == 0 and np.isfinite(numbers).all():
                rings.append(numbers.reshape(-1, 3))
        if rings:
            yield rings
