"""Cloud-optimised GeoTIFFs: reads only the required blocks of remote files by HTTP ranges.

Files are given by URL or found in a STAC catalogue.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform_bounds

from localizer.errors import GeoreferenceError, MapFetchError, MapSourceError
from localizer.map.fetch.area import Area
from localizer.map.fetch.catalogue import CatalogueSource
from localizer.map.fetch.http_client import HttpAnswer, HttpClient, safe_url
from localizer.map.fetch.raster import FetchGrid, FetchPlan, Piece, grid_over, split_grid
from localizer.map.importers.height_crs import flat_crs, stated_heights, utm_zone
from localizer.map.importers.raster_file import HeightBand, height_band, offline
from localizer.map.importers.rules import DEFAULT_RULES

NODATA = -32768.0
_HEIGHT_BYTES, _PICTURE_BYTES = 3.0, 0.8
_BLOCK = 1 << 18
_KEPT_BLOCKS = 64  # 16 MiB a file that is open
_MOST_FILES = 500
_NOT_THERE = 404


class NoFileError(MapFetchError):
    """A file that a server does not have."""


class RangeFile(io.RawIOBase):
    """A remote file as a Python file object, read in cached blocks; one thread. failed: receives
    errors, which GDAL would replace by a generic one.
    """

    def __init__(self, url: str, client: HttpClient, failed: list[MapFetchError]) -> None:
        super().__init__()
        self._url, self._client, self._failed = url, client, failed
        self._at = 0
        self._size = 0
        self._block = lru_cache(_KEPT_BLOCKS)(self._asked)
        self._block(0)

    def readable(self) -> bool:
        """Always True."""
        return True

    def seekable(self) -> bool:
        """Always True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set the position of the next read; returns it."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(base + offset, 0)
        return self._at

    def tell(self) -> int:
        """Position of the next read."""
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Read as many bytes as `buffer` holds, or as are left; returns their number."""
        wanted = memoryview(buffer).cast("B")
        end = min(self._at + len(wanted), self._size)
        done = 0
        while self._at < end:
            number, offset = divmod(self._at, _BLOCK)
            part = self._block(number)[offset : offset + end - self._at]
            if not part:
                break
            wanted[done : done + len(part)] = part
            done += len(part)
            self._at += len(part)
        return done

    def _asked(self, number: int) -> bytes:
        begin = number * _BLOCK
        asked = {"Range": f"bytes={begin}-{begin + _BLOCK - 1}"}
        try:
            # Only at its begin: one that goes away in between is a fault of the server.
            answer = self._client.get(self._url, asked, () if self._size else (_NOT_THERE,))
            self._require_part(answer)
        except MapFetchError as error:
            self._failed.append(error)
            raise
        return answer.data

    def _require_part(self, answer: HttpAnswer) -> None:
        """Check the answer to a request of a block; the first one tells the file's size."""
        url = safe_url(self._url)
        if answer.status == _NOT_THERE:
            raise NoFileError(f"{url}: status {_NOT_THERE}: there is no such file")
        if answer.status != 206:
            raise MapFetchError(
                f"{url}: the server gives whole files only (no HTTP ranges): download it once and "
                "use `companion map build`"
            )
        if not self._size:
            total = answer.headers.get("content-range", "").rpartition("/")[2]
            if not total.isdigit():
                raise MapFetchError(f"{url}: does not say how long the file is")
            self._size = int(total)


@dataclass(frozen=True)
class CloudFile:
    """A remote GeoTIFF. bounds: west, south, east, north in degrees, which it covers in part.
    may_lack: it may not exist, because its URL was constructed.
    """

    url: str
    bounds: tuple[float, float, float, float]
    may_lack: bool = False


def plan_files(
    source: CatalogueSource, area: Area, resolution_m: float, files: Sequence[CloudFile],
    client: HttpClient,
) -> FetchPlan:  # fmt: skip
    """Plan the windows of the files that meet an area, on the files' common grid if there is one.
    `MapFetchError` if there is no file or there are too many, `NoFileError` if none exists.
    """
    wanted = [f for f in files if area.meets(f.bounds)]
    if not wanted:
        raise MapFetchError(f"{source.name}: has no file at {area}")
    if len(wanted) > _MOST_FILES:
        raise MapFetchError(f"{source.name}: {len(wanted)} files: a smaller area")
    there = [f for f in wanted if not f.may_lack or _exists(f, client)]
    if not there:
        raise NoFileError(
            f"{safe_url(wanted[0].url)}: there is no such file, nor of any other degree of the "
            "area: is it all sea? are latitude and longitude swapped?"
        )
    lacking = tuple(_name(f.url) for f in wanted if f not in there)
    grid = _grid_of(there, area, resolution_m, client)
    pieces = []
    for column, row, width, height in split_grid(grid, source.piece_px):
        window = grid.window(column, row, width, height)
        meeting = [f for f in there if _meets(window, f)]
        if meeting:
            get = partial(_window, source, window, tuple(meeting))
            pieces.append(Piece(f"{column}-{row}", column, row, width, height, get))
    size = _HEIGHT_BYTES if source.has_heights else _PICTURE_BYTES
    expected = size * grid.width * grid.height
    requests = len(there) + math.ceil(expected / _BLOCK)
    return FetchPlan(grid, tuple(pieces), size, requests, lacking)


def degree_files(source: CatalogueSource, area: Area) -> list[CloudFile]:
    """Files of a model cut by whole degrees (Copernicus GLO-30), otherwise the single file. Files
    of sea areas and of some restricted land do not exist.
    """
    if "{lat}" not in source.url:
        return [CloudFile(source.url, source.bounds)]
    found = []
    for south in range(math.floor(area.south), math.ceil(area.north)):
        for west in range(math.floor(area.west), math.ceil(area.east)):
            latitude = f"{'N' if south >= 0 else 'S'}{abs(south):02d}"
            longitude = f"{'E' if west >= 0 else 'W'}{abs(west):03d}"
            url = source.url.replace("{lat}", latitude).replace("{lon}", longitude)
            found.append(CloudFile(url, (west, south, west + 1, south + 1), may_lack=True))
    return found


def _grid_of(
    files: Sequence[CloudFile], area: Area, resolution_m: float, client: HttpClient
) -> FetchGrid:
    """The grid: the first file's CRS if in metres; its pixels if of the wished size."""
    crs, transform = _lie_of(files[0], client)
    flat = flat_crs(crs)
    if flat.is_geographic:
        utm = utm_zone(*area.centre)
        return grid_over(area.bounds_in(utm), (resolution_m, resolution_m), utm)
    unit = float(flat.axis_info[0].unit_conversion_factor)
    own = abs(transform.a), abs(transform.e)
    factor = max(round(resolution_m / unit / own[0]), 1)
    pixel = factor * own[0], factor * own[1]
    return grid_over(area.bounds_in(flat), pixel, flat, (transform.c, transform.f))


def _lie_of(file: CloudFile, client: HttpClient) -> tuple[CRS, Any]:
    """A file's CRS and transform."""
    with _opened(file.url, client, []) as data:
        if data.crs is None:
            raise MapFetchError(f"{safe_url(file.url)}: has no CRS")
        return CRS(data.crs), data.transform


def _exists(file: CloudFile, client: HttpClient) -> bool:
    return client.get(file.url, {"Range": "bytes=0-0"}, (_NOT_THERE,)).status != _NOT_THERE


def _name(url: str) -> str:
    """A file's name without the query of its URL, which may contain a key."""
    return url.rpartition("/")[2].partition("?")[0]


def _meets(window: FetchGrid, file: CloudFile) -> bool:
    west, south, east, north = transform_bounds(
        window.crs.to_wkt(), "EPSG:4326", *window.bounds, densify_pts=21
    )
    there = file.bounds
    return bool(west <= there[2] and there[0] <= east and south <= there[3] and there[1] <= north)


def _opened(url: str, client: HttpClient, failed: list[MapFetchError]) -> Any:
    """A dataset that reads through the client; GDAL itself gets no network access."""

    def opener(path: str, mode: str = "rb", **_: object) -> RangeFile:
        if mode not in ("r", "rb") or path != url:
            raise FileNotFoundError(path)  # files beside it are not asked for
        return RangeFile(url, client, failed)

    try:
        with offline():
            return rasterio.open(url, driver="GTiff", opener=opener, sharing=False)
    except RasterioError as error:
        if failed:
            raise failed[0] from error
        raise MapFetchError(f"{safe_url(url)}: no GeoTIFF that can be read: {error}") from error


def require_8_bits(name: str, dtype: str) -> None:
    """`MapFetchError` for images of more than 8 bits, whose value range is unknown."""
    if dtype != "uint8":
        raise MapFetchError(
            f"{name} has pixels of {dtype}, no image of 8 bits; ask for another layer or "
            "`format`, or scale it with `gdal_translate -ot Byte -scale`"
        )


def _window(
    source: CatalogueSource,
    window: FetchGrid,
    files: Sequence[CloudFile],
    client: HttpClient,
) -> bytes | None:
    """GeoTIFF of a window: each pixel is from the first file that has it. None without any."""
    bands = 1 if source.has_heights else 3
    dtype = np.float32 if source.has_heights else np.uint8
    whole = np.zeros((bands, window.height, window.width), dtype)
    known = np.zeros((window.height, window.width), bool)
    for file in files:
        read, has = _of_file(source, window, file.url, client)
        fresh = has & ~known
        whole[:, fresh] = read[:, fresh] if len(read) == bands else read[:1, fresh]
        known |= has
        if known.all():
            break
    return None if not known.any() else as_geotiff(whole, known, window)


def _of_file(
    source: CatalogueSource, window: FetchGrid, url: str, client: HttpClient
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """A window's bands (n, height, width) from one file, and the mask of known pixels."""
    failed: list[MapFetchError] = []
    try:
        with offline(), _opened(url, client, failed) as data:
            if not source.has_heights:
                require_8_bits(safe_url(url), data.dtypes[0])
            read, known = warped(source, _name(url), data, window)
            return read.astype(np.float32 if source.has_heights else np.uint8), known
    except RasterioError as error:
        raise MapFetchError(f"{safe_url(url)}: cannot be read: {error}") from error
    finally:
        if failed:
            raise failed[0]


def warped(
    source: CatalogueSource, name: str, data: Any, window: FetchGrid
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """A window's bands (n, height, width), heights in metres, of a file opened by rasterio that has
    a place, and the mask of known pixels.
    """
    options: dict[str, Any] = {"src_crs": flat_crs(CRS(data.crs)).to_wkt()}
    if source.nodata is not None:
        options |= {"src_nodata": source.nodata, "nodata": source.nodata}
    elif data.nodata is None:
        options["add_alpha"] = True
    with WarpedVRT(
        data, crs=window.crs.to_wkt(), transform=window.transform, width=window.width,
        height=window.height, tolerance=0.01,
        resampling=Resampling.bilinear if source.has_heights else Resampling.average, **options,
    ) as vrt:  # fmt: skip
        read = vrt.read(list(range(1, min(1 if source.has_heights else 3, data.count) + 1)))
        known = vrt.dataset_mask() > 0
    if source.has_heights:
        read = metres_of(source, name, data, window.crs).metres(read.astype(np.float64))
    return read, known


def as_geotiff(bands: np.ndarray, known: np.ndarray, window: FetchGrid) -> bytes:
    """Encode a piece as GeoTIFF. bands: (n, height, width); known: mask of valid pixels."""
    heights = bands.dtype == np.float32
    values = np.where(known, bands, NODATA if heights else 0).astype(bands.dtype)
    profile: dict[str, Any] = {
        "driver": "GTiff", "dtype": values.dtype.name, "count": len(values),
        "width": window.width, "height": window.height, "crs": window.crs.to_wkt(),
        "transform": window.transform, "compress": "deflate",
    }  # fmt: skip
    if heights:
        profile["nodata"] = NODATA
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), MemoryFile() as memory:
        with memory.open(**profile) as file:
            file.write(values)
            if heights:
                file.units = UNITS
            else:
                file.write_mask(known)
        return bytes(memory.read())


UNITS = ("m",)
"""Of what is written: a CRS in feet would else be asked for the heights' unit."""


def metres_of(source: CatalogueSource, name: str, data: Any, crs: CRS) -> HeightBand:
    """Conversion of a file's numbers to metres, by its unit, scale and offset. data: opened by
    rasterio; crs: used if the file has none. `MapFetchError` if the unit is unknown or the datum
    contradicts the source.
    """
    try:
        stated = stated_heights(crs if data.crs is None else CRS(data.crs), data.units[0], name)
        band, _ = height_band(Path(name), data, stated, None, None, DEFAULT_RULES)
    except (GeoreferenceError, MapSourceError) as error:
        raise MapFetchError(f"{source.name}: {error}") from error
    if stated.datum is not None and stated.datum != source.vertical_datum:
        raise MapFetchError(
            f"{source.name}: the heights of {name} are {stated.datum} by its CRS ({stated.crs}), "
            f"the source says {source.vertical_datum}; correct its vertical_datum"
        )
    return band
