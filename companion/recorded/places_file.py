"""Reads positions of photos from a file beside them: CSV or text, one line a photo.

With a header, columns are found by name. Without one, lines are ``name longitude latitude
[altitude]``, as in OpenDroneMap's geo.txt and this project's pose files.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator
from pathlib import Path

from companion.errors import FootageError
from companion.recorded.flight import (
    Datum,
    Height,
    RecordedPosition,
    RecordedView,
    Telemetry,
)
from localizer.plain_files import plain_text

PLACES_SUFFIXES = frozenset({".csv", ".txt", ".tsv"})
_UNKNOWN_M, _HEIGHT_M = 5.0, 25.0  # of a position and a height of which no one says the source
_COLUMNS = {
    "name": ("name", "filename", "file", "image", "photo", "label", "imagename"),
    "latitude": ("lat", "latitude", "gpslatitude", "latitudedeg", "y"),
    "longitude": ("lon", "lng", "long", "longitude", "gpslongitude", "longitudedeg", "x"),
    "amsl": ("alt", "altitude", "z", "elevation", "gpsaltitude", "altamslm", "amsl", "altm"),
    "ellipsoid": ("height", "heightm", "ellipsoidalheight", "hae"),
    "takeoff": ("relalt", "relativealtm", "relativealtitude", "agl", "heightabovetakeoff"),
    "roll": ("gimbalroll", "gimbalrolldeg", "cameraroll"),
    "pitch": ("gimbalpitch", "gimbalpitchdeg", "camerapitch"),
    "yaw": ("gimbalyaw", "gimbalyawdeg", "camerayaw"),
    "course": ("heading", "course", "track", "yaw", "yawdeg"),
    "time": ("utc", "timestamp", "unixtime"),
    "accuracy": ("horizontalaccuracy", "hacc", "gpsxyaccuracy", "accuracy"),
}
_LIMITS = {  # degrees; seconds since 1970, whose nanoseconds fit 64 bits; metres
    "roll": (-180.0, 180.0), "pitch": (-180.0, 90.0), "yaw": (-360.0, 360.0),
    "course": (-360.0, 360.0), "time": (0.0, 9e9), "accuracy": (1e-3, 1e5),
}  # fmt: skip


def read_places(path: Path) -> dict[str, Telemetry]:
    """Telemetry by photo name, as the file writes it; position None for 0, 0. `FootageError` for a
    file without lines of positions, a line that is none, and a name that is repeated.
    """
    try:
        lines = plain_text(path).removeprefix("\ufeff").splitlines()
        rows = list(_rows(lines))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FootageError(f"{path}: cannot be read: {error}") from error
    columns = _columns(rows[0][1]) if rows else None
    if columns is not None:
        rows = rows[1:]
    else:
        columns = {"name": 0, "longitude": 1, "latitude": 2, "amsl": 3}
    places: dict[str, Telemetry] = {}
    for number, row in rows:
        name, said = _place(row, columns, f"{path}:{number}")
        if name in places:
            raise FootageError(f"{path}:{number}: a second line of {name}; leave the right one")
        places[name] = said
    if not places:
        raise FootageError(f"{path}: holds no place; expected lines of: name longitude latitude")
    return places


def _rows(lines: list[str]) -> Iterator[tuple[int, list[str]]]:
    """(line number, fields) of lines that are not empty: by comma, semicolon, tab or blanks."""
    kept = [
        (number, line)
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.startswith("#") and not line.upper().startswith("EPSG:")
    ]
    sample = kept[0][1] if kept else ""
    mark = next((m for m in (",", ";", "\t") if m in sample), None)
    for number, line in kept:
        fields = next(csv.reader([line], delimiter=mark)) if mark else line.split()
        yield number, [f.strip() for f in fields]


def _columns(first: list[str]) -> dict[str, int] | None:
    """Index of each known column, if the first row is a header; otherwise None."""
    if len(first) > 1 and _number(first[1]) is not None:
        return None
    plain = [re.sub(r"[^a-z]", "", name.lower()) for name in first]
    found = {}
    for key, names in _COLUMNS.items():
        index = next((plain.index(name) for name in names if name in plain), None)
        if index is not None:
            found[key] = index
    if not {"name", "latitude", "longitude"} <= found.keys():
        return None
    return found


def _place(row: list[str], columns: dict[str, int], where: str) -> tuple[str, Telemetry]:
    def number(key: str) -> float | None:
        index = columns.get(key)
        value = _number(row[index]) if index is not None and index < len(row) else None
        low, high = _LIMITS.get(key, (-math.inf, math.inf))
        if value is not None and not low <= value <= high:
            raise FootageError(f"{where}: {key} {value:g} is not from {low:g} to {high:g}")
        return value

    latitude, longitude = number("latitude"), number("longitude")
    if latitude is None or longitude is None or len(row) <= columns["name"]:
        raise FootageError(f"{where}: expected a name, longitude and latitude, got {row[:4]}")
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        raise FootageError(
            f"{where}: latitude {latitude:g}, longitude {longitude:g} is no place on Earth: are "
            "they swapped? Without a header, longitude comes before latitude"
        )
    heights = [
        Height(value, datum, _HEIGHT_M)
        for key, datum in (
            ("ellipsoid", Datum.ELLIPSOID), ("amsl", Datum.AMSL), ("takeoff", Datum.TAKEOFF)
        )
        if (value := number(key)) is not None
    ]  # fmt: skip
    position = None
    if latitude or longitude:  # 0, 0 is what is written without a fix
        sigma_m = number("accuracy") or _UNKNOWN_M
        position = RecordedPosition(latitude, longitude, sigma_m, tuple(heights))
    roll, pitch, yaw = number("roll"), number("pitch"), number("yaw")
    view = None
    if pitch is not None and yaw is not None:
        view = RecordedView.of_angles(roll or 0.0, pitch, yaw)
    seconds = number("time")
    time_ns = None if seconds is None else round(seconds * 1e9)
    return row[columns["name"]], Telemetry(time_ns, position, view, number("course"))


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
