"""One GeoTIFF on disk, opened without GDAL's other formats, and its metadata."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.pose import Array
from localizer.map.importers.height_crs import (
    StatedHeights,
    horizontal_unit_m,
    place_doubts,
    unit_of,
)
from localizer.map.importers.rules import ImportRules, require_plain_file
from localizer.map.kind import IMAGERY_DATE

_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_DATE_TAGS = ("ACQUISITIONDATETIME", "ACQUISITION_DATE", "ACQUISITIONDATE", "IMAGERY_DATE")
_SENSOR_TAGS = ("SATELLITEID", "SENSOR", "SENSOR_ID", "PLATFORM")
_FLAT_CELLS = 512  # of a flat ground's side, at most
_MAX_SIDECAR_BYTES = 16 << 20
# What sidecar files may name is not fetched: no address of the network is one of these. Vertical
# keys of GeoTIFF 1.0 are reported only when they are asked for.
_GDAL_OPTIONS = {
    "GTIFF_REPORT_COMPD_CS": "YES",
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "/vsicurl/none",
    "CPL_VSIL_CURL_USE_HEAD": "NO",
    "GDAL_HTTP_MAX_RETRY": "0",
    "GDAL_HTTP_TIMEOUT": "1",
    "GDAL_HTTP_CONNECTTIMEOUT": "1",
}


@contextmanager
def offline() -> Iterator[None]:
    """Context for every use of GDAL, without network access."""
    with rasterio.Env(**_GDAL_OPTIONS):
        yield


def open_raster(path: Path) -> DatasetReader:
    """Open a GeoTIFF under `offline`; the caller closes it. `MapSourceError` for another file."""
    require_plain_file(path)
    _require_tiff(path)
    for beside in (f"{path}.ovr", f"{path}.msk"):
        if Path(beside).exists():
            require_plain_file(Path(beside))
            _require_tiff(Path(beside))
    _require_plain_sidecar(Path(f"{path}.aux.xml"))
    try:
        return rasterio.open(path, driver="GTiff")
    except RasterioError as error:
        raise MapSourceError(f"{path}: cannot be read as a raster: {error}") from error


def write_flat_ground(ortho: Path, height_m: float, path: Path, rules: ImportRules) -> Path:
    """Write a constant height model below an orthophoto, for a flat map, to `path`, and return
    that. `MapSourceError` or `GeoreferenceError` if the orthophoto has heights or no georeference.
    """
    with offline(), open_raster(ortho) as data:
        require_sane(ortho, data, rules)
        if data.count == 1 and data.dtypes[0] != "uint8":
            raise MapSourceError(
                f"{ortho}: holds heights; --flat-ground is for an orthophoto alone"
            )
        across, down = (min(n, _FLAT_CELLS) for n in (data.width, data.height))
        transform = data.transform * Affine.scale(data.width / across, data.height / down)
        heights = np.full((1, down, across), height_m, np.float32)
        shape = {"width": across, "height": down, "count": 1, "dtype": "float32"}
        place = {"crs": data.crs, "transform": transform, "nodata": -9999.0}
        with rasterio.open(path, "w", driver="GTiff", compress="deflate", **shape, **place) as out:
            out.write(heights)
    return path


def open_cached(path: Path) -> DatasetReader:
    """As `open_raster`, but kept for the next tile of the same process: do not close it."""
    stat = path.stat()
    return _kept(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4)
def _kept(path: Path, _modified_ns: int, _size: int) -> DatasetReader:
    return open_raster(path)


def _require_tiff(path: Path) -> None:
    with path.open("rb") as file:
        start = file.read(4)
    if start not in _TIFF:
        raise MapSourceError(
            f"{path}: cannot be read as a raster: it is no GeoTIFF, whatever its name; GDAL's "
            "other formats are not opened (gdal_translate -of COG makes one of them a GeoTIFF)"
        )


def _require_plain_sidecar(path: Path) -> None:
    """`MapSourceError` if an .aux.xml makes GDAL open another file; statistics are allowed."""
    if not path.exists():
        return
    require_plain_file(path)
    if path.stat().st_size > _MAX_SIDECAR_BYTES:
        raise MapSourceError(f"{path}: larger than {_MAX_SIDECAR_BYTES} bytes; remove it")
    text = path.read_bytes().lower()
    if any(word in text for word in (b"overview_file", b"/vsi", b"://", b"<!entity")):
        raise MapSourceError(f"{path}: names other files or addresses; remove it")


def require_sane(path: Path, data: DatasetReader, rules: ImportRules) -> list[str]:
    """Check size, CRS and georeference of a raster; returns accepted doubts as warnings.
    `GeoreferenceError` if one is missing or singular.
    """
    rules.require("pixels", float(data.width) * data.height, path)
    if data.crs is None:
        raise GeoreferenceError(f"{path}: the raster has no CRS; assign it one")
    numbers = np.array(data.transform[:6], np.float64)
    if data.transform.is_identity:
        what = "only control points" if data.gcps[0] else "no place"
        raise GeoreferenceError(
            f"{path}: the raster has {what} (no geotransform); warp it first (gdalwarp)"
        )
    if not np.isfinite(numbers).all() or abs(data.transform.determinant) < 1e-18:
        raise GeoreferenceError(f"{path}: the raster's geotransform {numbers.tolist()} is singular")
    return _placed(path, data, rules)


def _placed(path: Path, data: DatasetReader, rules: ImportRules) -> list[str]:
    """Doubts about the position of its corners; an error if that is nowhere on Earth."""
    crs = CRS(data.crs)
    if not crs.is_geographic and not crs.is_projected:
        raise GeoreferenceError(
            f"{path}: its CRS, {crs.name}, is neither geographic nor projected: nothing says where "
            "on Earth it lies; assign it one that does"
        )
    x, y = apply_affine(
        data.transform,
        np.array([0.0, data.width, 0.0, data.width]),
        np.array([0.0, 0.0, data.height, data.height]),
    )
    try:
        lon, lat = _flat(crs.to_wkt(), "EPSG:4326").transform(x, y)
    except ProjError as error:
        raise GeoreferenceError(f"{path}: its CRS, {crs.name}: {error}") from error
    if not (np.isfinite(lon).all() and (np.abs(lat) <= 90.0).all()):
        raise GeoreferenceError(
            f"{path}: its corners ({x[0]:g}, {y[0]:g} ...) lie outside the area where its CRS, "
            f"{crs.name}, is defined; are easting and northing, or longitude and latitude, swapped?"
        )
    if crs.is_geographic and max(abs(x)) > 180.0:  # GDAL leaves out what lies beyond
        raise GeoreferenceError(
            f"{path}: reaches from longitude {min(x):.4f} to {max(x):.4f}, beyond the date line; "
            "warp it into a projected CRS, such as the UTM zone there (gdalwarp -t_srs)"
        )
    return place_doubts(crs, lon, lat, path, rules)


def has_own_mask(data: DatasetReader) -> bool:
    """Whether the file marks missing pixels: nodata, alpha or a mask."""
    return MaskFlags.all_valid not in data.mask_flag_enums[0]


def colour_bands(path: Path, data: DatasetReader) -> tuple[int, int, int]:
    """Band numbers of red, green and blue, equal for grey; `MapSourceError` for a palette."""
    meaning = list(data.colorinterp)
    if meaning[0] == ColorInterp.palette:
        raise MapSourceError(
            f"{path}: its colours are indices into a palette; expand them (gdal_translate -expand "
            "rgb)"
        )
    if data.count < 3 or meaning[1] == ColorInterp.alpha:
        return 1, 1, 1
    wanted = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    if all(meaning.count(colour) == 1 for colour in wanted):
        red, green, blue = (meaning.index(colour) + 1 for colour in wanted)
        return red, green, blue
    return 1, 2, 3


def stated_imagery(data: DatasetReader) -> tuple[str | None, str | None]:
    """Date (year, month or day) and sensor of an orthophoto, by its tags; None if unknown.

    It reads GDAL's IMAGERY tags and the plain tags of some vendors. TIFFTAG_DATETIME is not read,
    because it is the time of the file and not of the photos.
    """
    stated = data.tags() | data.tags(ns="IMAGERY")
    tags = {name.upper(): text.strip() for name, text in stated.items()}
    dates = (re.match(IMAGERY_DATE, tags.get(name, "")) for name in _DATE_TAGS)
    sensors = (tags.get(name) for name in _SENSOR_TAGS)
    return next((d[0] for d in dates if d), None), next((s[:80] for s in sensors if s), None)


def has_separate_mask(data: DatasetReader) -> bool:
    """Whether missing pixels are in a mask, which warping does not transform by itself."""
    flags = data.mask_flag_enums[0]
    return MaskFlags.per_dataset in flags and MaskFlags.alpha not in flags


def apply_affine(transform: Affine, x: Array, y: Array) -> tuple[Array, Array]:
    """Apply a transform to points: a raster's takes its columns and rows to its CRS, the inverse
    back. Independent of affine's version.
    """
    t = transform
    return t.a * x + t.b * y + t.c, t.d * x + t.e * y + t.f


def is_on_raster(data: DatasetReader, crs: str, x: Array, y: Array) -> NDArray[np.bool_]:
    """Mask of the points x, y (equal shapes) of a CRS that are on the raster."""
    transformer = _flat(crs, CRS(data.crs).to_wkt())
    source_x, source_y = transformer.transform(x, y)
    column, row = apply_affine(~data.transform, np.asarray(source_x), np.asarray(source_y))
    slack = 1e-3  # of a pixel
    return np.asarray(
        (column >= -slack)
        & (row >= -slack)
        & (column <= data.width + slack)
        & (row <= data.height + slack)
    )


@lru_cache(maxsize=8)
def _flat(source: str, target: str) -> Transformer:
    return Transformer.from_crs(CRS(source).to_2d(), CRS(target).to_2d(), always_xy=True)


@dataclass(frozen=True)
class HeightBand:
    """Makes metres of a DSM's values: value * gain + offset. missing: one more nodata value."""

    gain: float = 1.0
    offset: float = 0.0
    missing: float | None = None

    def metres(self, values: Array) -> Array:
        """Convert values; the same array if they are metres already."""
        if (self.gain, self.offset) == (1.0, 0.0):
            return values
        return values * self.gain + self.offset


METRES = HeightBand()


def height_band(
    path: Path,
    data: DatasetReader,
    stated: StatedHeights,
    height_unit: str | None,
    nodata: float | None,
    rules: ImportRules,
) -> tuple[HeightBand, list[str]]:
    """Conversion of the DSM's numbers to metres, and warnings. height_unit, nodata: given by the
    user, or None. `GeoreferenceError` for an unknown unit, `MapSourceError` if scale and offset
    give no heights.
    """
    unit, warnings = stated.unit_m, []
    if height_unit is not None:
        given = unit_of(height_unit)
        if unit is not None and abs(given / unit - 1) > 1e-4:
            warnings.append(
                rules.accept(
                    "datum",
                    f"{path}: --height-unit {height_unit}, but the file says units of {unit:g} m",
                )
            )
        unit = given
    if unit is None:
        if horizontal_unit_m(CRS(data.crs)) != 1.0:
            raise GeoreferenceError(
                f"{path}: its CRS is in feet and it does not say whether its heights are; give "
                "--height-unit m, ft or us-ft"
            )
        unit = 1.0
    gain, offset = float(data.scales[0] or 1.0), float(data.offsets[0])
    if not (math.isfinite(gain) and gain > 0 and math.isfinite(offset)):
        raise MapSourceError(
            f"{path}: its band's scale {gain:g} and offset {offset:g} make no heights of its "
            "numbers; correct them (gdal_edit -scale -offset)"
        )
    if nodata is not None and data.nodata is not None and nodata != data.nodata:
        warnings.append(f"{path.name}: --nodata {nodata:g} instead of its own {data.nodata:g}")
    return HeightBand(gain * unit, offset * unit, nodata), warnings
