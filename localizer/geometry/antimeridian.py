"""Outlines across the 180th meridian, where longitude jumps from 180 to -180 degrees.

The minimum and maximum of such longitudes would span the rest of the Earth.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

Corner = tuple[float, float]


@dataclass(frozen=True)
class GeoBox:
    """A box in degrees. Across the 180th meridian east is less than west (RFC 7946, 5.2)."""

    south: float
    west: float
    north: float
    east: float

    def line(self) -> str:
        """The box as text."""
        return (
            f"latitude {self.south:.5f} to {self.north:.5f}, longitude {self.west:.5f} to "
            f"{self.east:.5f}"
        )


def wrapped(longitude_deg: float) -> float:
    """The longitude in [-180, 180); 180 itself stays."""
    return longitude_deg if abs(longitude_deg) <= 180.0 else lon_near(longitude_deg, 0.0)


def lon_near(longitude_deg: float, reference_deg: float) -> float:
    """The longitude plus a multiple of 360 that is nearest to a reference; it may be beyond 180."""
    return longitude_deg + 360.0 * round((reference_deg - longitude_deg) / 360.0)


def geo_box(places: Iterable[tuple[float, float]]) -> GeoBox:
    """The box of one or more positions (latitude, longitude) less than half the Earth apart."""
    latitudes, longitudes = zip(*places, strict=True)
    near = [lon_near(longitude, longitudes[0]) for longitude in longitudes]
    return GeoBox(min(latitudes), wrapped(min(near)), max(latitudes), wrapped(max(near)))


def split_outline(ring: Sequence[Corner]) -> list[list[Corner]]:
    """Cut a convex outline (longitude, latitude; not closed) at the 180th meridian: one or two
    outlines (RFC 7946, 3.1.9).
    """
    near = [(lon_near(lon, ring[0][0]), lat) for lon, lat in ring]
    parts = []
    for turn in (-360.0, 0.0, 360.0):
        part = [(lon + turn, lat) for lon, lat in near]
        part = _clipped(_clipped(part, -180.0, 1.0), 180.0, -1.0)
        if len({lon for lon, _ in part}) > 1:
            parts.append(part)
    return parts


def _clipped(ring: Sequence[Corner], limit: float, sign: float) -> list[Corner]:
    """An outline's part beyond a meridian in the direction of `sign` (Sutherland, Hodgman)."""
    kept: list[Corner] = []
    for (x, y), (a, b) in zip(ring, [*ring[1:], *ring[:1]], strict=True):
        here, there = sign * (x - limit) >= 0.0, sign * (a - limit) >= 0.0
        if here:
            kept.append((x, y))
        if here != there:
            kept.append((limit, y + (limit - x) / (a - x) * (b - y)))
    return kept
