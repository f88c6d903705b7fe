"""The raster that is put together, and the pieces that it is asked for in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from affine import Affine
from pyproj import CRS

from localizer.errors import MapFetchError
from localizer.map.fetch.polite import PoliteClient

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
        """A part of it."""
        left, top = self.left + column * self.pixel[0], self.top - row * self.pixel[1]
        return FetchGrid(self.crs, left, top, self.pixel, width, height)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, bottom, right, top."""
        right = self.left + self.width * self.pixel[0]
        return self.left, self.top - self.height * self.pixel[1], right, self.top


@dataclass(frozen=True)
class Piece:
    """What is asked for at once. column, row: of its first pixel in the whole, which may be
    negative; get: its image, as bytes that GDAL reads, None where the service has nothing; placed:
    whether the image says itself where it lies.
    """

    name: str
    column: int
    row: int
    width: int
    height: int
    get: Callable[[PoliteClient], bytes | None]
    placed: bool = False


@dataclass(frozen=True)
class FetchPlan:
    """All that is needed of one source. bytes_per_pixel: of what is sent, a guess; requests: of all
    pieces, a guess where a piece takes several. lacking: names of files that the server does not
    have: nothing is known where they would be.
    """

    grid: FetchGrid
    pieces: tuple[Piece, ...]
    bytes_per_pixel: float
    requests: int
    lacking: tuple[str, ...] = ()

    @property
    def bytes(self) -> float:
        """That will come, about."""
        return self.bytes_per_pixel * sum(p.width * p.height for p in self.pieces)


def grid_over(
    bounds: tuple[float, float, float, float],
    pixel: tuple[float, float],
    crs: CRS,
    origin: tuple[float, float] = (0.0, 0.0),
) -> FetchGrid:
    """The pixels that cover bounds; their corners lie at multiples of a pixel from an origin."""
    left, bottom, right, top = bounds
    first = math.floor((left - origin[0]) / pixel[0]), math.floor((origin[1] - top) / pixel[1])
    last = math.ceil((right - origin[0]) / pixel[0]), math.ceil((origin[1] - bottom) / pixel[1])
    return FetchGrid(
        crs, origin[0] + first[0] * pixel[0], origin[1] - first[1] * pixel[1], pixel,
        max(last[0] - first[0], 1), max(last[1] - first[1], 1),
    )  # fmt: skip


def cut(grid: FetchGrid, side: int) -> list[tuple[int, int, int, int]]:
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
    """Whether the CRS by its own definition names northing or latitude first."""
    return bool(crs.axis_info) and crs.axis_info[0].direction.lower() in ("north", "south")


def metres_per_unit(crs: CRS, latitude_deg: float) -> tuple[float, float]:
    """Of its first and second axis at a latitude. Web Mercator's metres are stretched ones."""
    if crs.is_geographic:
        return 111_320.0 * math.cos(math.radians(latitude_deg)), 110_574.0
    factor = float(crs.axis_info[0].unit_conversion_factor)
    if crs.to_epsg() == 3857:
        factor *= math.cos(math.radians(latitude_deg))
    return factor, factor
