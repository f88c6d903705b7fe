"""Writes a flight's targets for maps: ``targets.geojson`` (RFC 7946), ``targets.kml`` (OGC KML
2.2).

Made from ``targets.csv`` when the record is closed, or later from any record.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

GEOJSON_NAME = "targets.geojson"
KML_NAME = "targets.kml"
_KML = "http://www.opengis.net/kml/2.2"
_TRACK_STEP_NS = 1_000_000_000  # between the places of a moving target's line
_LONGEST_TRACK = 3600


@dataclass
class _TargetRows:
    """Collected rows of one target. place: newest (longitude, latitude, height); track: the same
    while it moved.
    """

    name: str
    reports: int = 0
    first_ns: int = 0
    last_ns: int = 0
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma_m: float = 0.0
    sigma_up_m: float = 0.0
    elsewhere: float = 0.0
    velocity: tuple[float, float] | None = None
    track: list[tuple[float, float, float]] = field(default_factory=list)
    tracked_ns: int = -_TRACK_STEP_NS

    def add(self, row: dict[str, str]) -> None:
        """Add a row; ValueError for one that was cut off, as by a full disk."""
        time_ns = int(row["exposure_time_ns"])
        place = tuple(float(row[k]) for k in ("longitude_deg", "latitude_deg", "height_m"))
        sigma = float(row["sigma_horizontal_m"]), float(row["sigma_up_m"])
        velocity = None
        if row["velocity_east"]:
            velocity = float(row["velocity_east"]), float(row["velocity_north"])
        elsewhere = float(row["elsewhere"])
        if not all(map(math.isfinite, (*place, *sigma, elsewhere))):
            raise ValueError("not finite")
        self.place = place[0], place[1], place[2]
        (self.sigma_m, self.sigma_up_m), self.elsewhere = sigma, elsewhere
        self.velocity, self.last_ns = velocity, time_ns
        self.first_ns = self.first_ns or time_ns
        self.reports += 1
        is_due = time_ns - self.tracked_ns >= _TRACK_STEP_NS
        if velocity is not None and is_due and len(self.track) < _LONGEST_TRACK:
            self.track.append(self.place)
            self.tracked_ns = time_ns


def write_target_files(folder: Path) -> int:
    """Write both files beside ``targets.csv``; returns the number of targets. No file is written
    without targets.

    Raises OSError.
    """
    targets = list(_read(folder / "targets.csv"))
    if not targets:
        return 0
    utc_minus_monotonic = _clock_offset_ns(folder / "record.json")
    document = {
        "type": "FeatureCollection",
        "features": [_feature(t, utc_minus_monotonic) for t in targets],
    }
    text = json.dumps(document, indent=1, ensure_ascii=False)
    (folder / GEOJSON_NAME).write_text(text, encoding="utf-8")
    kml = ElementTree.tostring(_kml(targets, utc_minus_monotonic), encoding="utf-8")
    (folder / KML_NAME).write_bytes(b'<?xml version="1.0" encoding="UTF-8"?>\n' + kml)
    return len(targets)


def _read(path: Path) -> Iterator[_TargetRows]:
    targets: dict[str, _TargetRows] = {}
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        for row in csv.DictReader(line.replace("\0", "") for line in file):
            name = row.get("target_id") or ""
            target = targets.get(name) or _TargetRows(name)
            try:
                target.add(row)
            except (KeyError, TypeError, ValueError):
                continue
            targets[name] = target
    yield from targets.values()


def _clock_offset_ns(manifest: Path) -> int | None:
    """UTC minus CLOCK_MONOTONIC, ns; None if the record does not state it."""
    try:
        document = json.loads(manifest.read_text(encoding="utf-8"))
        return int(document["utc_ns"]) - int(document["monotonic_ns"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _utc(time_ns: int, offset_ns: int | None) -> str | None:
    if offset_ns is None:
        return None
    moment = datetime.fromtimestamp((time_ns + offset_ns) * 1e-9, tz=timezone.utc)
    return moment.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"


def _properties(target: _TargetRows, offset_ns: int | None) -> dict[str, Any]:
    speed = course = None
    if target.velocity is not None:
        east, north = target.velocity
        speed = round(math.hypot(east, north), 2)
        course = round(math.degrees(math.atan2(east, north)) % 360.0, 1)
    return {
        "name": target.name,
        "reports": target.reports,
        "first_seen": _utc(target.first_ns, offset_ns),
        "last_seen": _utc(target.last_ns, offset_ns),
        "sigma_horizontal_m": target.sigma_m,
        "sigma_up_m": target.sigma_up_m,
        "elsewhere": target.elsewhere,
        "speed_mps": speed,
        "course_deg": course,
    }


def _feature(target: _TargetRows, offset_ns: int | None) -> dict[str, Any]:
    """GeoJSON of a target: a point at the newest position, and a line if it moved. Ellipsoidal
    heights.
    """
    point: dict[str, Any] = {"type": "Point", "coordinates": list(target.place)}
    geometry = point
    if len(target.track) > 1:
        line = {"type": "LineString", "coordinates": [list(p) for p in target.track]}
        geometry = {"type": "GeometryCollection", "geometries": [point, line]}
    return {
        "type": "Feature",
        "id": target.name,
        "geometry": geometry,
        "properties": _properties(target, offset_ns),
    }


def _kml(targets: list[_TargetRows], offset_ns: int | None) -> ElementTree.Element:
    """KML marks on the ground, because KML's heights are above a geoid that the viewer chooses."""
    root = ElementTree.Element("kml", xmlns=_KML)
    document = ElementTree.SubElement(root, "Document")
    ElementTree.SubElement(document, "name").text = "Targets"
    for target in targets:
        mark = ElementTree.SubElement(document, "Placemark")
        ElementTree.SubElement(mark, "name").text = target.name
        known = _properties(target, offset_ns) | {"height_above_ellipsoid_m": target.place[2]}
        lines = (f"{key}: {value}" for key, value in known.items() if value is not None)
        ElementTree.SubElement(mark, "description").text = "\n".join(lines)
        parent = mark
        if len(target.track) > 1:
            parent = ElementTree.SubElement(mark, "MultiGeometry")
            line = ElementTree.SubElement(parent, "LineString")
            ElementTree.SubElement(line, "tessellate").text = "1"
            text = " ".join(f"{lon},{lat}" for lon, lat, _ in target.track)
            ElementTree.SubElement(line, "coordinates").text = text
        point = ElementTree.SubElement(parent, "Point")
        ElementTree.SubElement(point, "altitudeMode").text = "clampToGround"
        ElementTree.SubElement(point, "coordinates").text = f"{target.place[0]},{target.place[1]}"
    return root
