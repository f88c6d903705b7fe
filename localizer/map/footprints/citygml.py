"""Reads footprints of buildings and their parts from CityGML 1.0 to 3.0 (OGC 20-010)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.footprints.footprint import (
    MOST_BYTES,
    Footprint,
    Footprints,
    ring_of,
    sane_height,
)
from localizer.map.importers.height_crs import UNITS, horizontal_unit_m
from localizer.plain_files import plain_bytes

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
    crs = _crs(path, root) if buildings else ""
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


def _crs(path: Path, root: ElementTree.Element) -> str:
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
