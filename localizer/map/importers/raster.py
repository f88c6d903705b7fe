"""DSM and orthophoto to tiles: a quadtree of height-field meshes, read window by window.

The grid of the finest level is the DSM's own, so its heights are kept as they are; each coarser
level averages 2 x 2. Vertical skirts along the tile borders hide the cracks between levels.
"""

# ruff: noqa: RUF005 (sums of arrays are meant, not lists)

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import rasterio
import rasterio.warp
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from rasterio._err import CPLE_BaseError
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader
from rasterio.vrt import WarpedVRT

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.map.importers.georeference import ecef_from_crs
from localizer.map.importers.heightmesh import ERROR_PER_STEP, height_mesh
from localizer.map.source import SourceMesh, SourceNode, SourceTree
from localizer.types import Image

TEXELS = 512  # of a tile's side
MIN_CELLS = 16  # of a tile's side


@dataclass(frozen=True)
class Grid:
    """The quadtree's geometry. crs: projected, metres, as WKT; left, top: of the first vertex;
    step: (east, south) metres between vertices of the finest level; cells: a tile's side.
    """

    crs: str
    left: float
    top: float
    step: tuple[float, float]
    cells: int
    levels: int


@dataclass(frozen=True)
class RasterTile:
    """Tile (column, row) of a level, 0 the coarsest; one `TileSource`."""

    dsm: Path
    ortho: Path
    grid: Grid
    level: int
    column: int
    row: int

    @property
    def name(self) -> str:
        """How errors name it."""
        return f"{self.level}/{self.column}/{self.row}"

    @property
    def step(self) -> tuple[float, float]:
        """Metres between this tile's vertices."""
        factor = 2 ** (self.grid.levels - 1 - self.level)
        return self.grid.step[0] * factor, self.grid.step[1] * factor

    def load(self) -> Sequence[SourceMesh]:
        """See `TileSource.load`."""
        try:
            heights = self._heights()
            if heights.mask.all():
                return []
            image, shown = self._image()
        except (RasterioError, CPLE_BaseError, OSError, ValueError) as error:
            raise MapSourceError(f"cannot be read: {error}") from error
        mesh = height_mesh(heights, shown, self.step, lossless=self._finest)
        if mesh is None:
            return []
        local, faces = mesh
        left, top = self.corner
        crs_points = local + (left, top, 0.0)
        extent = np.array(self.step) * self.grid.cells
        uvs = (local[:, :2] * (1, -1) / extent).astype(np.float32)
        return [SourceMesh(ecef_from_crs(self.grid.crs, crs_points), uvs, faces, image)]

    @property
    def _finest(self) -> bool:
        return self.level == self.grid.levels - 1

    @property
    def corner(self) -> tuple[float, float]:
        """Easting and northing of the first vertex."""
        east, south = (s * self.grid.cells for s in self.step)
        return self.grid.left + self.column * east, self.grid.top - self.row * south

    def _heights(self) -> np.ma.MaskedArray:
        """Heights at the vertices, (cells + 1, cells + 1) float64; masked where unknown."""
        (east, south), (left, top) = self.step, self.corner
        transform = Affine(east, 0, left - east / 2, 0, -south, top + south / 2)
        how = Resampling.bilinear if self._finest else Resampling.average
        n = self.grid.cells + 1
        with _warped(self.dsm, self.grid.crs, transform, n, how) as vrt:
            heights = vrt.read(1, masked=True).astype(np.float64)
            bad = ~np.isfinite(heights.filled(np.nan)) | (vrt.dataset_mask() == 0)
        return np.ma.masked_array(heights.data, bad)

    def _image(self) -> tuple[Image, NDArray[np.bool_]]:
        """Texture (TEXELS, TEXELS, 3), and per texel whether the orthophoto shows something."""
        (east, south), (left, top) = self.step, self.corner
        size = self.grid.cells / TEXELS
        transform = Affine(east * size, 0, left, 0, -south * size, top)
        with _warped(self.ortho, self.grid.crs, transform, TEXELS, Resampling.average) as vrt:
            bands = (1, 2, 3) if vrt.count >= 3 else (1, 1, 1)
            image = np.moveaxis(vrt.read(bands), 0, -1)
            shown = vrt.dataset_mask() > 0
        return np.ascontiguousarray(image, np.uint8), shown


def read_rasters(paths: Sequence[Path]) -> SourceTree:
    """The tree of a DSM (one band of heights) and an orthophoto (bands of colours)."""
    dsm, ortho = _told_apart(paths)
    with rasterio.open(dsm) as heights, rasterio.open(ortho) as colours:
        grid = _grid(heights, colours)
        centre = ecef_from_crs(grid.crs, np.array([[*_centre(heights, grid.crs), 0.0]]))[0]
        bounds = rasterio.warp.transform_bounds(heights.crs, grid.crs, *heights.bounds)
        # With what lies beside them: world files, statistics, overviews, masks, a mosaic's parts.
        beside = {Path(name) for data in (heights, colours) for name in data.files}
    files = (dsm, ortho, *sorted(beside - {dsm, ortho}))
    return SourceTree(_node(RasterTile(dsm, ortho, grid, 0, 0, 0), bounds), centre, None, "", files)


def _node(tile: RasterTile, bounds: tuple[float, float, float, float]) -> SourceNode:
    """The subtree of a tile. bounds: the DSM's left, bottom, right, top in the grid's CRS."""
    grid = tile.grid
    children = []
    if tile.level < grid.levels - 1:
        for row in (2 * tile.row, 2 * tile.row + 1):
            for column in (2 * tile.column, 2 * tile.column + 1):
                child = replace(tile, level=tile.level + 1, column=column, row=row)
                left, top = child.corner
                # The last vertex sits half a step inside the DSM's edge.
                if left < bounds[2] - grid.step[0] and top > bounds[1] + grid.step[1]:
                    children.append(_node(child, bounds))
    error = ERROR_PER_STEP * max(tile.step) if children else 0.0
    return SourceNode(error, True, (tile,), children)


def _told_apart(paths: Sequence[Path]) -> tuple[Path, Path]:
    found: dict[str, Path] = {}
    for path in paths:
        try:
            with rasterio.open(path) as data:
                if data.crs is None:
                    raise GeoreferenceError(f"{path}: the raster has no CRS; assign it one")
                kind = _kind(data)
        except RasterioError as error:
            raise MapSourceError(f"{path}: cannot be read as a raster: {error}") from error
        if kind in found:
            raise MapSourceError(f"{path}: a second {kind}; give one DSM and one orthophoto")
        found[kind] = path
    for kind in ("DSM", "orthophoto"):
        if kind not in found:
            raise MapSourceError(
                "a map of rasters needs a DSM and an orthophoto of the same ground: "
                f"the {kind} is missing"
            )
    return found["DSM"], found["orthophoto"]


def _kind(data: DatasetReader) -> str:
    """By the bands: heights are one band wider than a byte, colours are bytes."""
    bands = zip(data.dtypes, data.colorinterp, strict=True)
    colours = [dtype for dtype, meaning in bands if meaning != ColorInterp.alpha]
    if len(colours) == 1 and colours[0] != "uint8":
        return "DSM"
    if all(dtype == "uint8" for dtype in colours) and len(colours) in (1, 3, 4):
        return "orthophoto"
    kinds = ", ".join(sorted(set(colours)))
    raise MapSourceError(
        f"{data.name}: {len(colours)} bands of {kinds}: neither a DSM (one band of heights) nor an "
        "orthophoto (8-bit grey or RGB)"
    )


def _grid(dsm: DatasetReader, ortho: DatasetReader) -> Grid:
    crs = _metric_crs(dsm)
    if CRS(dsm.crs) == crs and not dsm.transform.b and not dsm.transform.d:
        step = abs(dsm.transform.a), abs(dsm.transform.e)
        left, bottom, right, top = dsm.bounds
    else:
        transform, width, height = rasterio.warp.calculate_default_transform(
            dsm.crs, crs.to_wkt(), dsm.width, dsm.height, *dsm.bounds
        )
        step = abs(transform.a), abs(transform.e)
        left, top = transform.c, transform.f
        right, bottom = left + width * step[0], top - height * step[1]
    gsd = _texel_size(ortho, crs)
    cells = max(MIN_CELLS, 2 * math.ceil(TEXELS * gsd / max(step) / 2))
    cells = min(cells, TEXELS)
    span = max((right - left) / step[0], (top - bottom) / step[1]) / cells
    levels = 1 + max(0, math.ceil(math.log2(max(span, 1.0))))
    return Grid(crs.to_wkt(), left + step[0] / 2, top - step[1] / 2, step, cells, levels)


def _metric_crs(data: DatasetReader) -> CRS:
    """The raster's own horizontal CRS where that is in metres, else the UTM zone of its centre."""
    own = CRS(data.crs)
    flat = own.sub_crs_list[0] if own.is_compound else own
    metric = all(axis.unit_name in ("metre", "meter", "m") for axis in flat.axis_info[:2])
    if flat.is_projected and metric:
        return flat
    lon, lat = _centre(data, "EPSG:4326")
    return CRS.from_epsg((32600 if lat >= 0 else 32700) + int((lon + 180) // 6) % 60 + 1)


def _centre(data: DatasetReader, crs: str) -> tuple[float, float]:
    x, y = data.xy(data.height / 2, data.width / 2, offset="ul")
    transformer = Transformer.from_crs(CRS(data.crs).to_2d(), CRS(crs), always_xy=True)
    x, y = transformer.transform(x, y)
    return float(x), float(y)


def _texel_size(ortho: DatasetReader, crs: CRS) -> float:
    transform, _, _ = rasterio.warp.calculate_default_transform(
        ortho.crs, crs.to_wkt(), ortho.width, ortho.height, *ortho.bounds
    )
    return float(math.sqrt(abs(transform.a * transform.e)))


@lru_cache(maxsize=4)
def _opened(path: Path) -> DatasetReader:
    return rasterio.open(path)


@contextmanager
def _warped(
    path: Path, crs: str, transform: Affine, size: int, how: Resampling
) -> Iterator[WarpedVRT]:
    """A raster resampled to a square grid."""
    data = _opened(path)
    same = CRS(data.crs) == CRS(crs)
    with WarpedVRT(
        data,
        src_crs=data.crs,
        crs=data.crs if same else crs,
        transform=transform,
        width=size,
        height=size,
        resampling=how,
        tolerance=0.01,  # of a pixel; 0 is refused
    ) as vrt:
        yield vrt
