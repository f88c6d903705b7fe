"""Raise building footprints on a terrain: flat roofs and vertical walls.

Roof: the lowest ground under the building and its height. A height field's walls lean over one
cell, so cells of more than half a metre are divided.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.features import rasterize
from rasterio.io import DatasetReader

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.footprints.footprint import Footprint, Footprints, read_citygml, read_geojson
from localizer.map.importers.height_crs import horizontal_unit_m, stated_heights
from localizer.map.importers.raster_file import apply_affine, offline, open_raster

_WALL_M = 0.5  # a cell, over which a wall may lean
_DEGREE_M = 111_000.0
_MOST_CELLS = 4e8
_NODATA = -32768.0
_GML = (".gml", ".xml", ".citygml")


@dataclass(frozen=True)
class RaiseResult:
    """Numbers of buildings. missed: outside the terrain; small: smaller than a cell; by_storeys,
    left_out: of `Footprints`. cell_m: side of the surface's cells.
    """

    raised: int
    missed: int
    small: int
    by_storeys: int
    left_out: int
    cell_m: float

    def line(self) -> str:
        """The result as text."""
        parts = [f"{self.raised} buildings raised in cells of {self.cell_m:.2f} m"]
        if self.by_storeys:
            parts.append(f"{self.by_storeys} of them by their storeys at 3 m")
        for count, why in (
            (self.left_out, "without a height or an outline"), (self.missed, "beside the terrain"),
            (self.small, "smaller than a cell"),
        ):  # fmt: skip
            if count:
                parts.append(f"{count} left out: {why}")
        return "; ".join(parts)


def read_footprints(path: Path, height_property: str | None = None) -> Footprints:
    """Read footprints of a GeoJSON or CityGML file, by its suffix. height_property: of GeoJSON, see
    `read_geojson`.
    """
    if path.suffix.lower() in _GML:
        return read_citygml(path)
    return read_geojson(path, height_property)


def raise_buildings(terrain: Path, footprints: Footprints, out: Path) -> RaiseResult:
    """Write the surface `out`, a GeoTIFF in the terrain's CRS, replacing a file there.
    `MapSourceError` if no building is on the terrain, or its heights are not in metres.
    """
    try:
        with offline(), open_raster(terrain) as data:
            _require_metres(terrain, data)
            parts, cell_m = _division(data)
            heights, transform = _divided(data, parts)
            placed = _placed(footprints, data)
            bare = heights.copy()  # what overlapping buildings stand on
            counts = [_burn(heights, bare, transform, building) for building in placed]
            raised = counts.count("raised")
            if not raised:
                raise MapSourceError(
                    f"{footprints.path}: none of its {len(placed)} buildings meets {terrain}; "
                    f"its CRS is taken to be {footprints.crs}"
                )
            _write(data, heights, transform, out)
    except (RasterioError, ProjError) as error:
        raise MapSourceError(f"{terrain}, {footprints.path}: {error}") from error
    return RaiseResult(
        raised, counts.count("missed"), counts.count("small"), footprints.by_storeys,
        footprints.left_out, cell_m,
    )  # fmt: skip


def _require_metres(path: Path, data: DatasetReader) -> None:
    unit = stated_heights(CRS(data.crs), data.units[0], path).unit_m
    if unit is None:
        unit = horizontal_unit_m(CRS(data.crs))
    if unit != 1.0 or data.scales[0] not in (None, 1.0) or data.offsets[0] not in (None, 0.0):
        raise MapSourceError(f"{path}: heights in plain metres are needed to raise buildings on it")
    if data.count != 1 or data.dtypes[0] == "uint8":
        raise MapSourceError(f"{path}: no terrain (one band of heights)")


def _division(data: DatasetReader) -> tuple[int, float]:
    """Number of parts into which a cell's side is divided, and the length of a part, m."""
    step: float = max(abs(data.transform.a), abs(data.transform.e))
    if data.crs.is_geographic:
        step *= _DEGREE_M
    parts = max(1, int(np.ceil(step / _WALL_M - 1e-6)))
    if data.width * data.height * parts**2 > _MOST_CELLS:
        raise MapSourceError(
            f"{data.name}: {data.width * parts} x {data.height * parts} cells of {step / parts:.2f}"
            " m: cut the terrain to a smaller area"
        )
    return parts, step / parts


def _divided(data: DatasetReader, parts: int) -> tuple[Array, Affine]:
    """Heights (h, w), NaN where unknown, and their transform."""
    shape = data.height * parts, data.width * parts
    raw = data.read(1, masked=True, out_shape=shape, resampling=Resampling.bilinear)
    transform = data.transform @ Affine.scale(1 / parts, 1 / parts)
    return raw.astype(np.float32).filled(np.nan), transform


def _placed(footprints: Footprints, data: DatasetReader) -> list[Footprint]:
    """The buildings in the terrain's CRS. Files of GML differ in the order of a CRS's axes, so the
    order in which more buildings are on the terrain is used.
    """
    whole = Transformer.from_crs(CRS(footprints.crs), CRS(data.crs).to_2d(), always_xy=True)
    corners = np.array([b.polygons[0][0].mean(axis=0) for b in footprints.buildings])
    swap = footprints.either_order and _met(whole, corners[:, ::-1], data) > _met(
        whole, corners, data
    )
    order = (1, 0) if swap else (0, 1)
    placed = []
    for building in footprints.buildings:
        polygons = tuple(
            tuple(np.stack(whole.transform(*ring[:, order].T), axis=1) for ring in rings)
            for rings in building.polygons
        )
        placed.append(Footprint(polygons, building.height_m))
    return placed


def _met(whole: Transformer, places: Array, data: DatasetReader) -> int:
    x, y = whole.transform(*places.T)
    left, bottom, right, top = data.bounds
    return int(((x > left) & (x < right) & (y > bottom) & (y < top)).sum())


def _burn(heights: Array, bare: Array, transform: Affine, building: Footprint) -> str:
    """Raise a building; returns "raised", or why not. Where two overlap, the higher counts."""
    ring = np.concatenate([ring for rings in building.polygons for ring in rings])
    if not np.isfinite(ring).all():
        return "missed"
    columns, rows = apply_affine(~transform, ring[:, 0], ring[:, 1])
    height, width = heights.shape
    first = max(int(np.floor(rows.min())), 0), max(int(np.floor(columns.min())), 0)
    last = (
        min(int(np.ceil(rows.max())) + 1, height), min(int(np.ceil(columns.max())) + 1, width),
    )  # fmt: skip
    if last[0] <= first[0] or last[1] <= first[1]:
        return "missed"
    window = heights[first[0] : last[0], first[1] : last[1]]
    shapes = [
        ({"type": "Polygon", "coordinates": [ring.tolist() for ring in rings]}, 1)
        for rings in building.polygons
    ]
    here = transform @ Affine.translation(*first[::-1])
    inside = rasterize(shapes, window.shape, transform=here, dtype="uint8").astype(bool)
    if not inside.any():
        return "small"
    ground = bare[first[0] : last[0], first[1] : last[1]][inside]
    if not np.isfinite(ground).any():
        return "missed"
    window[inside] = np.fmax(window[inside], np.nanmin(ground) + building.height_m)
    return "raised"


def _write(data: DatasetReader, heights: Array, transform: Affine, out: Path) -> None:
    profile = {
        "driver": "GTiff", "width": heights.shape[1], "height": heights.shape[0], "count": 1,
        "dtype": "float32", "crs": data.crs, "transform": transform, "nodata": _NODATA,
        "tiled": True, "compress": "deflate", "predictor": 3, "BIGTIFF": "IF_SAFER",
    }  # fmt: skip
    partial = out.with_name(f".{out.name}.part")
    try:
        with rasterio.open(partial, "w", **profile) as file:
            file.write(np.where(np.isfinite(heights), heights, _NODATA).astype(np.float32), 1)
            if data.units[0]:
                file.units = (data.units[0],)
        os.replace(partial, out)
    except OSError as error:
        raise MapSourceError(f"{out}: cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)
