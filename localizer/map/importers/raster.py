"""Imports DSM and orthophoto: a quadtree of height-field meshes, read window by window.

The finest level has the DSM's own grid and heights; each coarser level averages 2 x 2. Vertical
skirts along the tile borders hide the cracks between levels.
"""

# ruff: noqa: RUF005 (sums of arrays are meant, not lists)

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio.warp
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio._err import CPLE_BaseError  # GDAL's own errors have no public name
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader
from rasterio.vrt import WarpedVRT

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.importers.georeference import ecef_from_crs
from localizer.map.importers.height_crs import flat_crs, stated_heights, utm_zone
from localizer.map.importers.heightmesh import ERROR_PER_STEP, height_mesh
from localizer.map.importers.raster_checks import (
    check_colours,
    check_heights,
    check_overlap,
)
from localizer.map.importers.raster_file import (
    METRES,
    HeightBand,
    colour_bands,
    has_own_mask,
    has_separate_mask,
    height_band,
    is_on_raster,
    offline,
    open_cached,
    open_raster,
    require_sane,
    stated_imagery,
)
from localizer.map.importers.rules import DEFAULT_RULES, HIGHEST_M, LOWEST_M, ImportRules
from localizer.map.source import SourceMesh, SourceNode, SourceTree
from localizer.types import Image

TEXELS = 512  # of a tile's side
MIN_CELLS = 16  # of a tile's side
_FLAT = "; over even ground --flat-ground METRES stands for it, which costs metres of accuracy"


@dataclass(frozen=True)
class HeightGrid:
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
    """Tile (column, row) of a level, 0 the coarsest; implements `TileSource`. colours: the
    orthophoto's bands of red, green and blue.
    """

    dsm: Path
    ortho: Path
    grid: HeightGrid
    level: int
    column: int
    row: int
    band: HeightBand = METRES
    colours: tuple[int, int, int] = (1, 2, 3)
    rules: ImportRules = DEFAULT_RULES

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
            with offline():
                heights = self._heights()
                if heights.mask.all():
                    return []
                image, shown = self._image()
        except (RasterioError, CPLE_BaseError, OSError, ValueError) as error:
            raise MapSourceError(f"cannot be read: {error.__cause__ or error}") from error
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
        with _warped(self.dsm, self.grid.crs, transform, n, how, self.band.missing) as vrt:
            raw = vrt.read(1, masked=True).astype(np.float64)
            bad = ~np.isfinite(raw.filled(np.nan)) | ~_shown(vrt, open_cached(self.dsm))
        if self.band.missing is None:
            bad |= ~self._on(self.dsm, left + east * np.arange(n), top - south * np.arange(n))
        heights = self.band.metres(raw.data)
        self._require_ground(heights[~bad])
        return np.ma.masked_array(heights, bad)

    def _require_ground(self, heights: Array) -> None:
        """Check this tile's heights, which the samples of the whole DSM may have missed."""
        odd = heights[(heights < LOWEST_M) | (heights > HIGHEST_M)]
        if len(odd):
            self.rules.accept("heights", f"a height of {odd[0]:g} m, which no ground on Earth has")

    def _on(
        self, path: Path, x: NDArray[np.floating], y: NDArray[np.floating]
    ) -> NDArray[np.bool_]:
        """Mask (len(y), len(x)) of grid points on a raster without its own mask."""
        data = open_cached(path)
        if has_own_mask(data):
            return np.ones((len(y), len(x)), bool)
        grid_x, grid_y = np.meshgrid(x, y)
        rim = np.ones(grid_x.shape, bool)
        rim[1:-1, 1:-1] = False
        if is_on_raster(data, self.grid.crs, grid_x[rim], grid_y[rim]).all():
            return np.ones(grid_x.shape, bool)
        return is_on_raster(data, self.grid.crs, grid_x, grid_y)

    def _image(self) -> tuple[Image, NDArray[np.bool_]]:
        """Texture (TEXELS, TEXELS, 3), and per texel whether the orthophoto shows something."""
        (east, south), (left, top) = self.step, self.corner
        size = self.grid.cells / TEXELS
        transform = Affine(east * size, 0, left, 0, -south * size, top)
        with _warped(self.ortho, self.grid.crs, transform, TEXELS, Resampling.average) as vrt:
            image = np.moveaxis(vrt.read(self.colours), 0, -1)
            shown = _shown(vrt, open_cached(self.ortho))
        middles = size * (np.arange(TEXELS) + 0.5)
        shown &= self._on(self.ortho, left + east * middles, top - south * middles)
        return np.ascontiguousarray(image, np.uint8), shown


def read_rasters(
    paths: Sequence[Path],
    rules: ImportRules | None = None,
    *,
    height_unit: str | None = None,
    nodata: float | None = None,
) -> SourceTree:
    """The tree of a DSM (one band of heights) and an orthophoto (bands of colours).

    height_unit: of the DSM if the file does not state it, see `UNITS`; nodata: number for a missing
    height, if the file does not state it. `MapSourceError` if a file cannot be read.
    """
    rules = rules or ImportRules()
    try:
        with offline():
            return _read_rasters(paths, rules, height_unit, nodata)
    except (RasterioError, CPLE_BaseError, ProjError) as error:
        names = ", ".join(map(str, paths))
        raise MapSourceError(f"{names}: cannot be read: {error.__cause__ or error}") from error


def _read_rasters(
    paths: Sequence[Path], rules: ImportRules, height_unit: str | None, nodata: float | None
) -> SourceTree:
    dsm, ortho, doubts = _told_apart(paths, rules)
    with open_raster(dsm) as heights, open_raster(ortho) as colours:
        stated = stated_heights(CRS(heights.crs), heights.units[0], dsm)
        band, warnings = height_band(dsm, heights, stated, height_unit, nodata, rules)
        warnings += doubts + check_heights(dsm, heights, band, rules)
        warnings += check_overlap(heights, band, colours, rules)
        bands = colour_bands(ortho, colours)
        warnings += check_colours(ortho, colours, bands)
        date, sensor = stated_imagery(colours)
        grid = _grid(heights, colours)
        centre = ecef_from_crs(grid.crs, np.array([[*_centre(heights, grid.crs), 0.0]]))[0]
        bounds = rasterio.warp.transform_bounds(
            flat_crs(CRS(heights.crs)), grid.crs, *heights.bounds
        )
        right, bottom = max(bounds[::2]), min(bounds[1::2])
        # With what lies beside them: world files, statistics, overviews, masks.
        beside = {Path(name) for data in (heights, colours) for name in data.files}
        root = RasterTile(dsm, ortho, grid, 0, 0, 0, band, bands, rules)
    files = (dsm, ortho, *sorted(beside - {dsm, ortho}))
    if stated.other_geoid:
        warnings.append(
            f"{dsm.name}: heights above {stated.crs}; they are lifted by EGM96, which may differ "
            "from it by a metre or two: give --geoid-separation from its own calculator"
        )
    node = _node(root, (right, bottom), itertools.count(1))
    options = "" if band == METRES else str(band)
    return SourceTree(
        node,
        centre,
        None,
        "",
        files,
        stated.datum,
        options,
        stated.crs,
        tuple(warnings),
        date,
        sensor,
    )


def _node(tile: RasterTile, corner: tuple[float, float], numbers: Iterator[int]) -> SourceNode:
    """The subtree of a tile. corner: the DSM's right and bottom edge in the grid's CRS; numbers: of
    the nodes.
    """
    tile.rules.require("nodes", next(numbers), tile.dsm)
    grid, children = tile.grid, []
    if tile.level < grid.levels - 1:
        for row in (2 * tile.row, 2 * tile.row + 1):
            for column in (2 * tile.column, 2 * tile.column + 1):
                child = replace(tile, level=tile.level + 1, column=column, row=row)
                left, top = child.corner
                # The last vertex sits half a step inside the DSM's edge.
                if left < corner[0] - grid.step[0] and top > corner[1] + grid.step[1]:
                    children.append(_node(child, corner, numbers))
    error = ERROR_PER_STEP * max(tile.step) if children else 0.0
    return SourceNode(error, True, (tile,), children)


def _told_apart(paths: Sequence[Path], rules: ImportRules) -> tuple[Path, Path, list[str]]:
    found: dict[str, Path] = {}
    warnings: list[str] = []
    for path in paths:
        with open_raster(path) as data:
            warnings += require_sane(path, data, rules)
            kind = _kind(data)
        if kind in found:
            raise MapSourceError(f"{path}: a second {kind}; give one DSM and one orthophoto")
        found[kind] = path
    for kind in ("DSM", "orthophoto"):
        if kind not in found:
            raise MapSourceError(
                "a map of rasters needs a DSM and an orthophoto of the same ground: "
                f"the {kind} is missing{_FLAT if kind == 'DSM' else ''}"
            )
    return found["DSM"], found["orthophoto"], warnings


def _kind(data: DatasetReader) -> str:
    """DSM or orthophoto, by the bands: one band wider than a byte, or bands of bytes."""
    bands = zip(data.dtypes, data.colorinterp, strict=True)
    colours = [dtype for dtype, meaning in bands if meaning != ColorInterp.alpha]
    if len(colours) == 1 and colours[0] != "uint8" and not colours[0].startswith("complex"):
        return "DSM"
    if all(dtype == "uint8" for dtype in colours) and len(colours) in (1, 3, 4):
        return "orthophoto"
    kinds = ", ".join(sorted(set(colours)))
    raise MapSourceError(
        f"{data.name}: {len(colours)} bands of {kinds}: neither a DSM (one band of heights) nor an "
        "orthophoto (8-bit grey or RGB)"
    )


def _grid(dsm: DatasetReader, ortho: DatasetReader) -> HeightGrid:
    crs = _metric_crs(dsm)
    if flat_crs(CRS(dsm.crs)) == crs and not dsm.transform.b and not dsm.transform.d:
        step = abs(dsm.transform.a), abs(dsm.transform.e)
        left, right = sorted((dsm.bounds.left, dsm.bounds.right))  # rows may run northwards
        bottom, top = sorted((dsm.bounds.bottom, dsm.bounds.top))
    else:
        transform, width, height = rasterio.warp.calculate_default_transform(
            flat_crs(CRS(dsm.crs)), crs.to_wkt(), dsm.width, dsm.height, *dsm.bounds
        )
        step = abs(transform.a), abs(transform.e)
        left, top = transform.c, transform.f
        right, bottom = left + width * step[0], top - height * step[1]
    gsd = _texel_size(ortho, crs)
    cells = max(MIN_CELLS, 2 * math.ceil(TEXELS * gsd / max(step) / 2))
    cells = min(cells, TEXELS)
    span = max((right - left) / step[0], (top - bottom) / step[1]) / cells
    levels = 1 + max(0, math.ceil(math.log2(max(span, 1.0))))
    return HeightGrid(crs.to_wkt(), left + step[0] / 2, top - step[1] / 2, step, cells, levels)


def _metric_crs(data: DatasetReader) -> CRS:
    """The raster's horizontal CRS if it is in metres, otherwise the UTM zone of its centre."""
    flat = flat_crs(CRS(data.crs))
    metric = all(axis.unit_name in ("metre", "meter", "m") for axis in flat.axis_info[:2])
    if flat.is_projected and metric:
        return flat
    lon, lat = _centre(data, "EPSG:4326")
    return utm_zone(lat, lon)


def _centre(data: DatasetReader, crs: str) -> tuple[float, float]:
    x, y = data.xy(data.height / 2, data.width / 2, offset="ul")
    transformer = Transformer.from_crs(CRS(data.crs).to_2d(), CRS(crs), always_xy=True)
    x, y = transformer.transform(x, y)
    return float(x), float(y)


def _texel_size(ortho: DatasetReader, crs: CRS) -> float:
    transform, _, _ = rasterio.warp.calculate_default_transform(
        flat_crs(CRS(ortho.crs)), crs.to_wkt(), ortho.width, ortho.height, *ortho.bounds
    )
    return float(math.sqrt(abs(transform.a * transform.e)))


def _shown(vrt: WarpedVRT, data: DatasetReader) -> NDArray[np.bool_]:
    """Mask of a warped raster's valid pixels: by its own mask and by the alpha band of the warping,
    which GDAL does not treat as a mask unless the heights are bytes.
    """
    shown: NDArray[np.bool_] = vrt.dataset_mask() > 0
    if vrt.count > data.count:
        shown &= vrt.read(vrt.count) > 0
    return shown


@contextmanager
def _warped(
    path: Path,
    crs: str,
    transform: Affine,
    size: int,
    how: Resampling,
    missing: float | None = None,
) -> Iterator[WarpedVRT]:
    """Context manager: a raster resampled to a square grid. missing: the user's nodata value."""
    data = open_cached(path)
    flat = flat_crs(CRS(data.crs))
    same = flat == CRS(crs)
    own = data.crs if flat == CRS(data.crs) else flat.to_wkt()
    # Beside a file that does not say what is missing GDAL's warper leaves zeros: a turned DSM got
    # vertices 400 m below its edge.
    unsaid = has_separate_mask(data) or not has_own_mask(data)
    marks: dict[str, float | bool] = {"add_alpha": True} if unsaid else {}
    if missing is not None:
        marks = {"src_nodata": missing, "nodata": missing}
    with WarpedVRT(
        data,
        src_crs=own,
        crs=own if same else crs,
        transform=transform,
        width=size,
        height=size,
        resampling=how,
        tolerance=0.01,  # of a pixel; 0 is refused
        **marks,
    ) as vrt:
        yield vrt
