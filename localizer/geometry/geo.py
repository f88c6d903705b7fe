"""WGS84, ECEF and the local ENU frame of a map (pyproj does the geodesy).

Heights are above the WGS84 ellipsoid; what MAVLink calls AMSL is ``height - geoid_separation``.

At the 180th meridian longitude jumps from 180 to -180 degrees: minimum and maximum of such
longitudes would span the rest of the Earth.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from pyproj import Transformer

from localizer.errors import GeoreferenceError
from localizer.geometry.pose import Array, Pose, matrix_from_euler

EARTH_RADIUS_M = 6.371e6  # mean
_ECEF_FROM_GEODETIC = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


@dataclass(frozen=True)
class Geodetic:
    """A WGS84 position: degrees, and metres above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    height_m: float

    def __post_init__(self) -> None:
        if not all(np.isfinite((self.latitude_deg, self.longitude_deg, self.height_m))):
            raise GeoreferenceError(f"not a position on Earth: {self._said}")
        if not (-90 <= self.latitude_deg <= 90 and -360 <= self.longitude_deg <= 360):
            swapped = abs(self.latitude_deg) <= 360 and abs(self.longitude_deg) <= 90
            raise GeoreferenceError(
                f"latitude or longitude out of range: {self._said}"
                + (" (the other way round?)" if swapped else "")
            )

    @property
    def _said(self) -> str:
        return (
            f"latitude {self.latitude_deg:g}, longitude {self.longitude_deg:g}, height "
            f"{self.height_m:g} m"
        )


def ecef_from_geodetic(latitude_deg: ArrayLike, longitude_deg: ArrayLike, h_m: ArrayLike) -> Array:
    """ECEF metres (..., 3) of WGS84 degrees and ellipsoidal metres."""
    x, y, z = _ECEF_FROM_GEODETIC.transform(longitude_deg, latitude_deg, h_m)
    return np.stack([x, y, z], axis=-1).astype(np.float64)


def geodetic_from_ecef(ecef: ArrayLike) -> Array:
    """(latitude_deg, longitude_deg, height_m), shape (..., 3), of ECEF metres (..., 3)."""
    ecef = np.asarray(ecef, dtype=np.float64)
    lon, lat, h = _ECEF_FROM_GEODETIC.transform(
        ecef[..., 0], ecef[..., 1], ecef[..., 2], direction="INVERSE"
    )
    return np.stack([lat, lon, h], axis=-1).astype(np.float64)


# ENU <-> NED is its own inverse: swap x and y, negate z.
NED_FROM_ENU: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# OpenCV's z (forward), x (right), y (down) are the x, y, z of a body or gimbal.
BODY_FROM_CAMERA: Array = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def level_camera(position: Array, heading_rad: float, pitch_rad: float) -> Pose:
    """world_from_camera (ENU) of a camera without roll. heading: clockwise from north; pitch: of
    the optical axis above the horizon.
    """
    attitude = matrix_from_euler(0.0, pitch_rad, heading_rad)
    return Pose(NED_FROM_ENU.T @ attitude @ BODY_FROM_CAMERA, position)


@dataclass(frozen=True)
class LocalFrame:
    """A tangent-plane ENU frame (metres, float64) about a WGS84 origin."""

    origin: Geodetic

    @cached_property
    def ecef_from_enu(self) -> Pose:
        """The frame's rigid transform to ECEF."""
        lat, lon = np.radians([self.origin.latitude_deg, self.origin.longitude_deg])
        sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
        east = [-so, co, 0.0]
        north = [-sl * co, -sl * so, cl]
        up = [cl * co, cl * so, sl]
        o = self.origin
        centre = ecef_from_geodetic(o.latitude_deg, o.longitude_deg, o.height_m)
        return Pose(np.column_stack([east, north, up]), centre)

    def enu_from_geodetic(
        self, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike
    ) -> Array:
        """ENU metres (..., 3) of WGS84 degrees and ellipsoidal metres."""
        ecef = ecef_from_geodetic(latitude_deg, longitude_deg, height_m)
        return self.ecef_from_enu.inverse.apply(ecef)

    def geodetic_from_enu(self, enu: ArrayLike) -> Array:
        """(latitude_deg, longitude_deg, height_m), shape (..., 3), of ENU metres (..., 3)."""
        return geodetic_from_ecef(self.ecef_from_enu.apply(enu))

    def position(self, enu: ArrayLike) -> Geodetic:
        """One ENU point (3,) as a `Geodetic`."""
        lat, lon, h = self.geodetic_from_enu(enu)
        return Geodetic(float(lat), float(lon), float(h))

    def ned_from_enu(self, position: Geodetic) -> Array:
        """Rotation (3, 3) from this frame's axes to NED at `position` (0.5 arcmin per km apart)."""
        local = LocalFrame(position).ecef_from_enu.rotation
        rotation: Array = NED_FROM_ENU @ local.T @ self.ecef_from_enu.rotation
        return rotation


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
