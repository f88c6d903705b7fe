"""Building footprints, and the reader of their files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array

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
