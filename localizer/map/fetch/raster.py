"""Grid of the raster to fetch, and its pieces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from affine import Affine
from pyproj import CRS

from localizer.errors import MapFetchError
from localizer.map.fetch.http_client import HttpClient

_MOST_PIXELS = 1e9
_MOST_PIECES = 200_000


@dataclass(frozen=True)
class FetchGrid:
    """Pixels in a CRS. left, top: of the first pixel's corner; pixel: (east, south), CRS units."""

    crs: CRS
    left: float
    top: float
    pixel: tuple[float, float]
    width: int
    height: int

    def __post_init__(self) -> None:
        if not 0 < self.width * self.height <= _MOST_PIXELS:
            raise MapFetchError(
                f"{self.width} x {self.height} pixels: a smaller area or a coarser --resolution"
            )

    @property
    def transform(self) -> Affine:
        """From column and row to the CRS."""
        return Affine(self.pixel[0], 0.0, self.left, 0.0, -self.pixel[1], self.top)

    def window(self, column: int, row: int, width: int, height: int) -> FetchGrid:
        """A part of the grid."""
        left, top = self.left + column * self.pixel[0], self.top - row * self.pixel[1]
        return FetchGrid(self.crs, left, top, self.pixel, width, height)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, bottom, right, top."""
        right = self.left + self.width * self.pixel[0]
        return self.left, self.top - self.height * self.pixel[1], right, self.top


@dataclass(frozen=True)
class Piece:
    """One request. column, row: of its first pixel in the grid, may be negative; get: fetches its
    image as bytes for GDAL, None without data; placed: whether the image has its own georeference.
    """

    name: str
    column: int
    row: int
    width: int
    height: int
    get: Callable[[HttpClient], bytes | None]
    placed: bool = False


@dataclass(frozen=True)
class FetchPlan:
    """All requests to one source. bytes_per_pixel: estimated; requests: number, estimated if a
    piece needs several; lacking: files missing on the server, whose area stays empty.
    """

    grid: FetchGrid
    pieces: tuple[Piece, ...]
    bytes_per_pixel: float
    requests: int
    lacking: tuple[str, ...] = ()

    @property
    def bytes(self) -> float:
        """Estimated download size."""
        return self.bytes_per_pixel * sum(p.width * p.height for p in self.pieces)


def grid_over(
    bounds: tuple[float, float, float, float],
    pixel: tuple[float, float],
    crs: CRS,
    origin: tuple[float, float] = (0.0, 0.0),
) -> FetchGrid:
    """The grid that covers bounds, aligned to multiples of a pixel from an origin."""
    left, bottom, right, top = bounds
    first = math.floor((left - origin[0]) / pixel[0]), math.floor((origin[1] - top) / pixel[1])
    last = math.ceil((right - origin[0]) / pixel[0]), math.ceil((origin[1] - bottom) / pixel[1])
    return FetchGrid(
        crs, origin[0] + first[0] * pixel[0], origin[1] - first[1] * pixel[1], pixel,
        max(last[0] - first[0], 1), max(last[1] - first[1], 1),
    )  # fmt: skip


def split_grid(grid: FetchGrid, side: int) -> list[tuple[int, int, int, int]]:
    """Column, row, width and height of pieces with at most `side` pixels a side. `MapFetchError` if
    there are too many.
    """
    count = math.ceil(grid.width / side) * math.ceil(grid.height / side)
    if count > _MOST_PIECES:
        raise MapFetchError(f"{count} pieces: a smaller area or a coarser --resolution")
    return [
        (column, row, min(side, grid.width - column), min(side, grid.height - row))
        for row in range(0, grid.height, side)
        for column in range(0, grid.width, side)
    ]


def north_first(crs: CRS) -> bool:
    """Whether the CRS defines northing or latitude as the first axis."""
    return bool(crs.axis_info) and crs.axis_info[0].direction.lower() in ("north", "south")


def metres_per_unit(crs: CRS, latitude_deg: float) -> tuple[float, float]:
    """Ground metres per unit of a CRS to the east and to the north, at a latitude."""
    if crs.is_geographic:
        return 111_320.0 * math.cos(math.radians(latitude_deg)), 110_574.0
    factor = float(crs.axis_info[0].unit_conversion_factor)
    if crs.to_epsg() == 3857:
        factor *= math.cos(math.radians(latitude_deg))
    return factor, factor
