"""Finds the part of a map that is free of faults."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.antimeridian import GeoBox, lon_near, wrapped
from localizer.geometry.geo import LocalFrame
from localizer.map.inspection.alignment import Mosaic

_CELL_OF_HEIGHT = 1 / 8  # a hole of a tenth of such a cell takes nothing from a view
_MOST_CELLS = 400  # a side
_LEAST_GOOD = 0.9  # of a cell
_RIM = 2  # cells of both sides: a ragged edge is no news


@dataclass(frozen=True)
class UsableArea:
    """The largest rectangle without faults. box: inside it; size_m: east and north; is_whole: it
    covers the map except for a margin of one cell.
    """

    box: GeoBox
    size_m: tuple[float, float]
    is_whole: bool

    def line(self) -> str:
        """The area as text."""
        east_m, north_m = self.size_m
        return f"{self.box.line()} ({east_m:.0f} x {north_m:.0f} m)"


def usable_part(
    mosaic: Mosaic, faulty: NDArray[np.bool_], height_m: float, frame: LocalFrame
) -> UsableArea | None:
    """The largest rectangle of cells that are 90 % free of faults; None without any.

    faulty: (h, w), True where the mosaic has nothing to match. height_m: of the flight; sets the
    size of the cells. frame: of the mosaic's metres.
    """
    rows, columns = faulty.shape
    cell = max(round(height_m * _CELL_OF_HEIGHT / mosaic.gsd_m), 1)
    cell = max(min(cell, min(rows, columns) // 8), -(-max(rows, columns) // _MOST_CELLS), 1)
    h, w = max(rows // cell, 1), max(columns // cell, 1)
    share = cv2.resize(faulty.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    found = largest_rectangle(share <= 1 - _LEAST_GOOD)
    if found is None:
        return None
    top, bottom = (r * rows / h for r in found[:2])
    left, right = (c * columns / w for c in found[2:])
    corners = [mosaic.place(r, c) for r in (top, bottom) for c in (left, right)]
    places = [frame.position(np.array([*corner, 0.0])) for corner in corners]
    north_west, north_east, south_west, south_east = (p.latitude_deg for p in places)
    about = frame.origin.longitude_deg
    beyond = [lon_near(p.longitude_deg, about) for p in places]  # in the same order
    return UsableArea(
        GeoBox(
            max(south_west, south_east),
            wrapped(max(beyond[0], beyond[2])),
            min(north_west, north_east),
            wrapped(min(beyond[1], beyond[3])),
        ),
        ((right - left) * mosaic.gsd_m, (bottom - top) * mosaic.gsd_m),
        found[1] - found[0] >= h - _RIM and found[3] - found[2] >= w - _RIM,
    )


def largest_rectangle(good: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """(first row, end row, first column, end column) of the largest all-true rectangle, or None."""
    best, found = 0, None
    above = np.zeros(good.shape[1], np.int64)
    for row, line in enumerate(good):
        above = np.where(line, above + 1, 0)
        waiting: list[tuple[int, int]] = []  # first column and height, rising
        for column, height in enumerate([*above.tolist(), 0]):
            first = column
            while waiting and waiting[-1][1] >= height:
                first, high = waiting.pop()
                if high * (column - first) > best:
                    best = high * (column - first)
                    found = (row + 1 - high, row + 1, first, column)
            waiting.append((first, height))
    return found
