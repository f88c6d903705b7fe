"""Height of the EGM96 geoid above the WGS84 ellipsoid; GNSS receivers use it for AMSL heights.

`grids/egm96-15.npz` is every third value of the 5' grid that GeographicLib redistributes (egm96-5;
EGM96 is a work of NIMA, NASA and Ohio State University, in the public domain): second differences
of centimetres, (721, 1440) int16, from 90° south northwards, from 180° west eastwards.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from localizer.geometry.pose import Array

_GRID = Path(__file__).parent / "grids" / "egm96-15.npz"
_PER_DEGREE = 4


def geoid_separation(latitude_deg: float, longitude_deg: float) -> float:
    """Height of the EGM96 geoid above the WGS84 ellipsoid, metres; negative where it is below.
    Subtract it from an ellipsoidal height for the AMSL height.
    """
    grid = _egm96()
    y = (np.clip(latitude_deg, -90.0, 90.0) + 90.0) * _PER_DEGREE
    x = ((longitude_deg + 180.0) % 360.0) * _PER_DEGREE
    row, column = min(int(y), len(grid) - 2), int(x)
    rows = np.clip(np.arange(row - 1, row + 3), 0, len(grid) - 1)
    columns = np.arange(column - 1, column + 3) % grid.shape[1]
    return float(_cubic(y - row) @ grid[np.ix_(rows, columns)] @ _cubic(x - column))


def _cubic(t: float) -> Array:
    """Weights (4,) of the values at -1, 0, 1, 2 for a place between 0 and 1 (Catmull and Rom)."""
    powers = np.array([1.0, t, t * t, t * t * t])
    basis = np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]])
    return np.asarray(0.5 * powers @ basis)


@cache
def _egm96() -> Array:
    """The grid in metres, (721, 1440)."""
    with np.load(_GRID) as stored:
        centimetres = stored["second_differences_cm"].astype(np.int32)
    return np.asarray(centimetres.cumsum(axis=0).cumsum(axis=1) / 100.0)
