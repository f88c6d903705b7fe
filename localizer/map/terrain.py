"""Terrain model: ground heights where the map has no surface.

It may be any GeoTIFF of heights (Copernicus' 30 m, a survey; `companion map fetch` downloads some).
Its datum is irrelevant: odometry uses the shape of the ground only (docs/explanation/odometry.md).

Relief: odometry scales with the height above the ground. Beyond the map the ground height is
unknown, and the more uncertain the farther away (odometry.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

from localizer.errors import MapSourceError
from localizer.geometry.geo import EARTH_RADIUS_M, LocalFrame
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileIndex
from localizer.map.importers.height_crs import stated_heights
from localizer.map.importers.raster_file import (
    HeightBand,
    apply_affine,
    height_band,
    offline,
    open_raster,
)
from localizer.map.importers.rules import DEFAULT_RULES, HIGHEST_M, LOWEST_M
from localizer.map.kind import MapKind
from localizer.types import Float32, GroundUncertainty

_LEAST_M, _MOST_M = 50.0, 500.0  # between two places: roofs and trenches no longer count
_LEAST_TILES, _MOST_TILES = 8, 2000
_LEAST_GRADE = 0.03  # of the most level of six real places; nothing promises the same beyond a map
_MEAN_SHARE = 0.5  # mean over root mean square of heights that cover a quarter of the ground


def ground_uncertainty(index: TileIndex, kind: MapKind) -> GroundUncertainty:
    """Uncertainty of the ground height in a map and beyond its edge.

    The grade is the root mean square of rise over distance between the lowest points of tiles. A
    flat map, or one with few tiles, tells no grade and gets the default, that of hills.
    """
    missing_m = _MEAN_SHARE * kind.unknown_height_sigma_m
    leaves = np.flatnonzero(index.child_count == 0)
    if kind.heights == "flat" or len(leaves) < _LEAST_TILES:
        return GroundUncertainty(missing_m=missing_m)
    leaves = leaves[:: -(-len(leaves) // _MOST_TILES)]
    low, high = index.box_min[leaves], index.box_max[leaves]
    a, b = np.triu_indices(len(leaves), 1)
    away = np.linalg.norm((low + high)[a, :2] - (low + high)[b, :2], axis=1) / 2.0
    near = (away >= _LEAST_M) & (away <= _MOST_M)
    if not near.any():
        return GroundUncertainty(missing_m=missing_m)
    grades = (low[a, 2] - low[b, 2])[near] / away[near]
    grade = max(float(np.sqrt(np.mean(grades**2))), _LEAST_GRADE)
    return GroundUncertainty(grade, missing_m)


_REACH_M = 20_000.0  # from the map's origin
_MOST_CELLS = 2_000  # of a side
_LEAST_CELL_M = 5.0
_MOST_PIXELS = 100_000_000
_STEEP, _STEEP_SHARE = 5.7, 0.25  # 80 degrees in so many cells is noise, as in a surface model
_OUTLINE = 9  # places per side of the raster, to find its box


@dataclass(frozen=True)
class TerrainGrid:
    """Heights (rows, columns) of the ground in the map's frame, north first. west, north: position
    of the first height, m. Beyond the grid's edge the ground has the edge's height.
    """

    heights: Float32
    west: float
    north: float
    cell_m: float

    def height(self, east: Array, north: Array) -> Array:
        """World z (m) at world positions, by bilinear interpolation; beyond the grid, that of its
        edge. east, north: metres, arrays of one shape.
        """
        row = (self.north - np.asarray(north)) / self.cell_m
        column = (np.asarray(east) - self.west) / self.cell_m
        found: Array = map_coordinates(
            self.heights, [row, column], np.float64, order=1, mode="nearest"
        )
        return found


def open_terrain(path: Path, frame: LocalFrame) -> TerrainGrid:
    """Read the part of a height GeoTIFF within 20 km of the origin of a map's `frame`. Missing
    heights there get the median of the others.

    `MapSourceError` if there is no such raster, no coordinate system, or no height there.
    """
    with offline():
        try:
            with open_raster(path) as raster:
                return _read(raster, path, frame)
        except (RasterioError, ProjError) as error:
            raise MapSourceError(f"{path}: cannot be read as a terrain model: {error}") from error


def _read(raster: DatasetReader, path: Path, frame: LocalFrame) -> TerrainGrid:
    if raster.crs is None:
        raise MapSourceError(f"{path}: no coordinate system: a terrain model needs one")
    band = _band(raster, path)
    there = Transformer.from_crs("EPSG:4326", CRS.from_user_input(raster.crs), always_xy=True)
    low, high = _box(raster, there, frame)
    if not (low < high).all():
        raise MapSourceError(f"{path}: lies more than {_REACH_M / 1e3:.0f} km from the map")
    across = float(np.hypot(raster.width, raster.height))
    cell_m = max(_LEAST_CELL_M, float(np.linalg.norm(high - low)) / across)
    cell_m = max(cell_m, float((high - low).max()) / _MOST_CELLS)
    columns, rows = (int(n) for n in np.maximum(np.ceil((high - low) / cell_m) + 1, 2))
    east, north = np.meshgrid(
        low[0] + cell_m * np.arange(columns), high[1] - cell_m * np.arange(rows)
    )
    fallen = (east**2 + north**2) / (2 * EARTH_RADIUS_M)
    flat = np.stack([east, north, -fallen], axis=-1)
    latitude, longitude, _ = np.moveaxis(frame.geodetic_from_enu(flat), -1, 0)
    x, y = there.transform(longitude, latitude)
    u, v = apply_affine(~raster.transform, np.asarray(x), np.asarray(y))
    heights = _heights(raster, path, band, u, v)
    known = np.isfinite(heights)
    if not known.any():
        raise MapSourceError(f"{path}: no height is known within {_REACH_M / 1e3:.0f} km")
    _require_ground(path, heights, cell_m)
    filled = np.where(known, heights, np.median(heights[known]))
    height = filled - frame.origin.height_m - fallen
    return TerrainGrid(height.astype(np.float32), float(low[0]), float(high[1]), cell_m)


def _band(raster: DatasetReader, path: Path) -> HeightBand:
    """Conversion of the raster's numbers to metres; an error for colours and complex numbers."""
    colours = (ColorInterp.red, ColorInterp.palette)
    if raster.count >= 3 or raster.colorinterp[0] in colours:
        raise MapSourceError(f"{path}: a picture, not heights: {raster.count} bands of colours")
    if np.dtype(raster.dtypes[0]).kind == "c":
        raise MapSourceError(f"{path}: complex numbers are no heights")
    crs = CRS.from_user_input(raster.crs)
    stated = stated_heights(crs, raster.units[0], path)
    return height_band(path, raster, stated, None, None, DEFAULT_RULES)[0]


def _heights(raster: DatasetReader, path: Path, band: HeightBand, u: Array, v: Array) -> Float32:
    """Heights (m) at pixel positions u, v of the raster; only the pixels around them are read."""
    left, top = (int(np.clip(np.floor(a.min()) - 1, 0, n - 1)) for a, n in _sides(raster, u, v))
    right, bottom = (int(np.clip(np.ceil(a.max()) + 1, 1, n)) for a, n in _sides(raster, u, v))
    width, height = max(right - left, 1), max(bottom - top, 1)
    if width * height > _MOST_PIXELS:
        raise MapSourceError(
            f"{path}: more than {_MOST_PIXELS:.0e} pixels within {_REACH_M / 1e3:.0f} km: make it "
            "coarser"
        )
    shape = min(height, 2 * u.shape[0]), min(width, 2 * u.shape[1])
    read = raster.read(
        1, window=Window(left, top, width, height), out_shape=shape, masked=True,
        out_dtype=np.float32, resampling=Resampling.average,
    )  # fmt: skip
    metres = np.asarray(band.metres(read.filled(np.nan)), np.float32)
    x, y = (u - left) * (shape[1] / width) - 0.5, (v - top) * (shape[0] / height) - 0.5
    found: Float32 = cv2.remap(
        metres, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"),
    )  # fmt: skip
    return found


def _sides(raster: DatasetReader, u: Array, v: Array) -> tuple[tuple[Array, int], ...]:
    return (u, raster.width), (v, raster.height)


def _require_ground(path: Path, heights: Float32, cell_m: float) -> None:
    """Reject heights that are no ground, such as unmarked missing values or noise."""
    known = heights[np.isfinite(heights)]
    low, high = float(known.min()), float(known.max())
    if low < LOWEST_M or high > HIGHEST_M:
        raise MapSourceError(
            f"{path}: heights from {low:.4g} to {high:.4g} m occur nowhere on Earth: missing ones "
            "that are not marked so (gdal_edit -a_nodata), or another unit (gdal_edit -units)"
        )
    marked = np.where(np.isfinite(heights), heights, np.nan)
    rises = np.abs(np.diff(marked, axis=1)) / cell_m
    rises = rises[np.isfinite(rises)]
    if len(rises) and float((rises > _STEEP).mean()) >= _STEEP_SHARE:
        raise MapSourceError(
            f"{path}: a quarter of its cells rise by more than 80 degrees: noise, or no heights"
        )


def _box(raster: DatasetReader, there: Transformer, frame: LocalFrame) -> tuple[Array, Array]:
    """(west, south), (east, north) of the raster near the origin, in the map's frame, m."""
    side = np.linspace(0.0, 1.0, _OUTLINE)
    u, v = (g.ravel() for g in np.meshgrid(side * raster.width, side * raster.height))
    x, y = apply_affine(raster.transform, u, v)
    longitude, latitude = there.transform(x, y, direction="INVERSE")
    places = frame.enu_from_geodetic(latitude, longitude, np.zeros_like(u))
    return (
        np.maximum(places[:, :2].min(axis=0), -_REACH_M),
        np.minimum(places[:, :2].max(axis=0), _REACH_M),
    )
