"""A rectangle of ground to fetch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Geod, Transformer

from localizer.errors import MapFetchError
from localizer.geometry.pose import Array

_WGS84 = Geod(ellps="WGS84")
_MOST_KM = 200.0  # from one side to the other
_DENSE = 21  # points along each side: what is straight in degrees is bent in a projection


@dataclass(frozen=True)
class Area:
    """A rectangle in WGS84, degrees."""

    west: float
    south: float
    east: float
    north: float

    def __post_init__(self) -> None:
        if not (-180 <= self.west < self.east <= 180 and -85 <= self.south < self.north <= 85):
            raise MapFetchError(
                f"no rectangle: west {self.west:g}, south {self.south:g}, east {self.east:g}, "
                f"north {self.north:g}; degrees, west before east, south before north, within "
                "85 degrees of latitude, not across the 180th meridian"
            )
        if max(self.size_m) > 1e3 * _MOST_KM:
            raise MapFetchError(f"more than {_MOST_KM:.0f} km from side to side: {self}")

    def __str__(self) -> str:
        width, height = self.size_m
        return (
            f"{self.west:.5f}, {self.south:.5f} to {self.east:.5f}, {self.north:.5f} "
            f"({1e-3 * width:.2f} x {1e-3 * height:.2f} km)"
        )

    @property
    def centre(self) -> tuple[float, float]:
        """Latitude and longitude, degrees."""
        return (self.south + self.north) / 2, (self.west + self.east) / 2

    @property
    def size_m(self) -> tuple[float, float]:
        """Width at the centre (east to west) and height (south to north), metres."""
        latitude, longitude = self.centre
        width = _WGS84.inv(self.west, latitude, self.east, latitude)[2]
        return float(width), float(_WGS84.inv(longitude, self.south, longitude, self.north)[2])

    def bounds_in(self, crs: CRS) -> tuple[float, float, float, float]:
        """Left, bottom, right, top in a CRS, its first axis being easting or longitude.
        `MapFetchError` if the CRS does not reach the area.
        """
        shares = np.linspace(0.0, 1.0, _DENSE)
        lon = self.west + (self.east - self.west) * shares
        lat = self.south + (self.north - self.south) * shares
        grid = np.meshgrid(lon, lat)
        x, y = Transformer.from_crs(4326, crs, always_xy=True).transform(*map(np.ravel, grid))
        found = float(np.min(x)), float(np.min(y)), float(np.max(x)), float(np.max(y))
        if not np.isfinite(found).all():
            raise MapFetchError(f"{crs.name} does not reach {self}")
        return found

    def within(self, other: tuple[float, float, float, float]) -> bool:
        """Whether it lies inside another rectangle (west, south, east, north)."""
        west, south, east, north = other
        return (
            west <= self.west and self.east <= east and south <= self.south and self.north <= north
        )

    def meets(self, other: Sequence[float]) -> bool:
        """Whether it overlaps another rectangle (west, south, east, north)."""
        west, south, east, north = other
        return (
            west <= self.east and self.west <= east and south <= self.north and self.south <= north
        )


def area_around(points: Array, margin_m: float) -> Area:
    """The rectangle that reaches `margin_m` beyond positions (n, 2), latitude and longitude in
    degrees, to all sides. `MapFetchError` without a position, or if the margin is not above 0 and
    at most 100 km.
    """
    at = np.asarray(points, np.float64).reshape(-1, 2)
    if not len(at) or not np.isfinite(at).all():
        raise MapFetchError("no place to fetch a map around")
    if not 0 < margin_m <= 5e2 * _MOST_KM:
        raise MapFetchError(f"a margin or radius of {margin_m:g} m; above 0 and up to 100 km")
    reach = margin_m * math.sqrt(2)  # to the corners
    corners = []
    for latitude, longitude in at:
        for bearing in (45.0, 135.0, 225.0, 315.0):
            lon, lat, _ = _WGS84.fwd(longitude, latitude, bearing, reach)
            corners.append((lon, lat))
    lon, lat = np.array(corners).T
    return Area(float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max()))
