"""Fetches one source over one area into one GeoTIFF: plan, estimate, download, join the pieces."""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from PIL import Image
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile
from rasterio.windows import Window

from localizer.errors import MapFetchError
from localizer.map.fetch.area import Area
from localizer.map.fetch.catalogue import CatalogueSource
from localizer.map.fetch.cloud import (
    NODATA,
    UNITS,
    degree_files,
    metres_of,
    plan_files,
    require_8_bits,
    warped,
)
from localizer.map.fetch.http_client import HttpClient
from localizer.map.fetch.raster import FetchPlan, Piece
from localizer.map.fetch.stac import stac_files
from localizer.map.fetch.tiles import plan_blocks, plan_tiles
from localizer.map.importers.raster_file import offline

_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_LARGER, _MOST_BANDS = 4, 16  # than asked for, of what says its own place; of any
_LOWEST_M, _HIGHEST_M = -1000.0, 9500.0


def assemble(source: CatalogueSource, plan: FetchPlan, folder: Path, out: Path) -> float:
    """Write the raster; missing pixels are masked. Returns the share of valid ones. `MapFetchError`
    if the pieces make no raster.
    """
    grid, heights = plan.grid, source.has_heights
    profile: dict[str, Any] = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "tiled": True,
        "crs": grid.crs.to_wkt(), "transform": grid.transform, "compress": "deflate",
        "BIGTIFF": "IF_SAFER", "dtype": "float32" if heights else "uint8",
        "count": 1 if heights else 3,
    }  # fmt: skip
    if heights:
        profile["nodata"] = NODATA
    else:
        profile["photometric"] = "RGB"
    partial = out.with_name(f".{out.name}.part")
    known_pixels = 0
    try:
        with (
            offline(),
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            rasterio.open(partial, "w", **profile) as file,
        ):
            if heights:
                file.units = UNITS
            else:
                file.write_mask(np.zeros((grid.height, grid.width), bool))
            for piece in plan.pieces:
                path = folder / piece.name
                if path.stat().st_size:
                    known_pixels += _place(source, plan, piece, path.read_bytes(), file)
        os.replace(partial, out)
    except RasterioError as error:
        raise MapFetchError(f"{source.name}: its answers make no raster: {error}") from error
    finally:
        partial.unlink(missing_ok=True)
    return known_pixels / (grid.width * grid.height)


def check_piece(source: CatalogueSource, piece: Piece, data: bytes) -> None:
    """`MapFetchError` for no complete image, more than 8 bits, or another size than asked for."""
    try:
        if data[:4] in _TIFF:
            with offline(), MemoryFile(data) as memory, memory.open(driver="GTiff") as image:
                bands, dtype = image.count, image.dtypes[0]
                _require_size(source, piece, (image.width, image.height), bands)
                image.read()  # what ends too early is kept for ever else, and fails each mosaic
        else:
            with _picture(data) as picture:
                bands = len(picture.getbands())
                _require_size(source, piece, picture.size, bands)
                picture.load()
                dtype = "uint16" if picture.mode[0] in "IF" else "uint8"
    except (
        RasterioError, OSError, ValueError, SyntaxError, Image.DecompressionBombError
    ) as error:  # fmt: skip
        raise MapFetchError(f"{source.name}: piece {piece.name} is no image: {error}") from error
    if not source.has_heights:
        require_8_bits(f"{source.name}: piece {piece.name}", dtype)
    elif bands != 1 or dtype == "uint8":
        raise MapFetchError(
            f"{source.name}: sends {bands} bands of {dtype}, no heights; set `format` to a GeoTIFF "
            "of numbers"
        )


def _require_size(source: CatalogueSource, piece: Piece, size: tuple[int, int], bands: int) -> None:
    """Check a piece's size before decoding: some formats expand a few bytes to gigabytes."""
    wanted = piece.width, piece.height
    large = piece.placed and max(size) > _LARGER * max(wanted)
    if large or bands > _MOST_BANDS or (size != wanted and not piece.placed):
        raise MapFetchError(
            f"{source.name}: piece {piece.name} is {size[0]} x {size[1]} pixels of {bands} bands, "
            f"asked for {wanted[0]} x {wanted[1]}"
        )


def _picture(data: bytes) -> Image.Image:
    """Open an image without a georeference; only formats of images are tried."""
    return Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP"))


def _place(source: CatalogueSource, plan: FetchPlan, piece: Piece, data: bytes, file: Any) -> int:
    """Write a piece at its position; returns its number of known pixels."""
    grid = plan.grid
    if data[:4] in _TIFF:
        with MemoryFile(data) as memory, memory.open(driver="GTiff") as image:
            values, known = _values(source, plan, piece, image)
    else:
        with _picture(data) as picture:
            pixels = np.asarray(picture.convert("RGBA"))
        values, known = np.moveaxis(pixels[..., :3], -1, 0), pixels[..., 3] > 0
    # A tile may reach beyond the raster.
    left, top = max(-piece.column, 0), max(-piece.row, 0)
    right = min(piece.width, grid.width - piece.column)
    bottom = min(piece.height, grid.height - piece.row)
    if right <= left or bottom <= top:
        return 0
    values, known = values[:, top:bottom, left:right], known[top:bottom, left:right]
    window = Window(piece.column + left, piece.row + top, right - left, bottom - top)
    if source.has_heights:
        known = known & (values[0] > _LOWEST_M) & (values[0] < _HIGHEST_M)
        file.write(np.where(known, values, NODATA).astype(np.float32), window=window)
    else:
        file.write(values.astype(np.uint8), window=window)
        file.write_mask(known, window=window)
    return int(known.sum())


def _values(
    source: CatalogueSource, plan: FetchPlan, piece: Piece, image: Any
) -> tuple[np.ndarray, np.ndarray]:
    """A piece's bands (bands, height, width), and the mask of known pixels."""
    wanted = 1 if source.has_heights else 3
    if piece.placed and image.crs is not None and not image.transform.is_identity:
        window = plan.grid.window(piece.column, piece.row, piece.width, piece.height)
        values, known = warped(source, piece.name, image, window)
    else:
        if (image.width, image.height) != (piece.width, piece.height):
            raise MapFetchError(f"{source.name}: piece {piece.name} has another size")
        values, known = image.read(), image.dataset_mask() > 0
        if source.nodata is not None:
            known &= values[0] != source.nodata
        values = values[:wanted]
        if source.has_heights:
            band = metres_of(source, piece.name, image, plan.grid.crs)
            values = band.metres(values.astype(np.float64))
    if len(values) < wanted:
        values = np.repeat(values[:1], wanted, axis=0)
    return values, known & np.isfinite(values.astype(np.float64)).all(axis=0)


_LINE_BYTES_PER_S = 2e6  # that a line and a server are taken to give, for an estimate
_LEAST_KNOWN = 0.5  # of a raster, below which it is no map of the place

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class FetchEstimate:
    """Estimated size and time of a download."""

    requests: int
    bytes: float
    seconds: float
    pixels: tuple[int, int]


def make_plan(
    source: CatalogueSource, area: Area, resolution_m: float, client: HttpClient
) -> FetchPlan:
    """Plan all requests; may query the service (capabilities, catalogue, file header)."""
    if source.kind in ("wms", "wcs"):
        return plan_blocks(source, area, resolution_m, client)
    if source.kind in ("xyz", "tms", "wmts"):
        return plan_tiles(source, area, resolution_m, client)
    if source.kind == "stac":
        files = stac_files(source, area, client)
    else:
        files = degree_files(source, area)
    return plan_files(source, area, resolution_m, files, client)


def estimate(source: CatalogueSource, plan: FetchPlan) -> FetchEstimate:
    """Estimate the download before it starts."""
    seconds = max(plan.requests / source.rate_per_s, plan.bytes / _LINE_BYTES_PER_S)
    size = plan.grid.width, plan.grid.height
    return FetchEstimate(plan.requests, plan.bytes, seconds, size)


def fetch(
    source: CatalogueSource, plan: FetchPlan, folder: Path, out: Path, client: HttpClient,
    progress: Progress = lambda _done, _total: None,
) -> float:  # fmt: skip
    """Download the raster to `out`. folder: keeps the pieces, for this download alone: those of an
    interrupted run of this plan are reused, and all its files are deleted if they are of another
    plan. Returns the share of valid pixels. `MapFetchError` if the source has less than half of the
    area.
    """
    _claim(source, plan, folder)
    missing = [p for p in plan.pieces if not (folder / p.name).exists()]
    done = len(plan.pieces) - len(missing)
    progress(done, len(plan.pieces))
    few = 4 * source.parallel  # at a time, so that an end does not wait for thousands
    with ThreadPoolExecutor(source.parallel, thread_name_prefix="fetch") as pool:
        for first in range(0, len(missing), few):
            part = missing[first : first + few]
            for _ in pool.map(lambda piece: _keep(source, piece, folder, client), part):
                done += 1
                progress(done, len(plan.pieces))
    known = assemble(source, plan, folder, out)
    if known < _LEAST_KNOWN:
        out.unlink(missing_ok=True)
        raise MapFetchError(
            f"{source.name}: has only {100 * known:.0f} % of the area; name another source"
        )
    return known


def _keep(source: CatalogueSource, piece: Piece, folder: Path, client: HttpClient) -> None:
    """Download a piece and write its file when it is complete; an empty file means "no data"."""
    data = piece.get(client)
    if data is not None:
        check_piece(source, piece, data)
    path = folder / piece.name
    partial = folder / f".{piece.name}.part"
    partial.write_bytes(data or b"")
    os.replace(partial, path)


def _claim(source: CatalogueSource, plan: FetchPlan, folder: Path) -> None:
    """Mark the folder as this plan's; pieces of another plan are removed."""
    told = {
        "source": source.model_dump(mode="json"), "crs": plan.grid.crs.to_wkt(),
        "left": plan.grid.left, "top": plan.grid.top, "pixel": plan.grid.pixel,
        "size": [plan.grid.width, plan.grid.height], "pieces": [p.name for p in plan.pieces],
    }  # fmt: skip
    key = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    mark = folder / "plan.sha256"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not mark.exists() or mark.read_text() != key:
            for path in folder.iterdir():
                path.unlink()
            mark.write_text(key)
    except OSError as error:
        raise MapFetchError(f"{folder}: cannot be used: {error}") from error
