"""Joins downloaded pieces to one GeoTIFF."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from PIL import Image
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile
from rasterio.windows import Window

from localizer.errors import MapFetchError
from localizer.map.fetch.catalogue import CatalogueSource
from localizer.map.fetch.cloud import NODATA, UNITS, metres_of, require_8_bits, warped
from localizer.map.fetch.raster import FetchPlan, Piece
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
