"""Slope statistics of a map's ground, used to extrapolate beyond its edge.

Odometry scales with the height above the ground. Beyond the map the ground height is unknown, and
the more uncertain the farther away (odometry.md).
"""

from __future__ import annotations

import numpy as np

from localizer.map.cache.cache import TileIndex
from localizer.map.kind import MapKind
from localizer.types import GroundUncertainty

_LEAST_M, _MOST_M = 50.0, 500.0  # between two places: roofs and trenches no longer count
_LEAST_TILES, _MOST_TILES = 8, 2000
_LEAST_GRADE = 0.03  # of the most level of six real places; nothing promises the same beyond a map
_MEAN_SHARE = 0.5  # mean over root mean square of heights that cover a quarter of the ground


def ground_uncertainty(index: TileIndex, kind: MapKind) -> GroundUncertainty:
    """Uncertainty of the ground height in a map and beyond its edge.

    The grade is the root mean square of rise over distance between the lowest points of tiles. A
    flat map, or one with few tiles, tells no grade and gets the default, that of hills.
    """
    missing_m = _MEAN_SHARE * kind.unknown_height_sigma_m
    leaves = np.flatnonzero(index.child_count == 0)
    if kind.heights == "flat" or len(leaves) < _LEAST_TILES:
        return GroundUncertainty(missing_m=missing_m)
    leaves = leaves[:: -(-len(leaves) // _MOST_TILES)]
    low, high = index.box_min[leaves], index.box_max[leaves]
    a, b = np.triu_indices(len(leaves), 1)
    away = np.linalg.norm((low + high)[a, :2] - (low + high)[b, :2], axis=1) / 2.0
    near = (away >= _LEAST_M) & (away <= _MOST_M)
    if not near.any():
        return GroundUncertainty(missing_m=missing_m)
    grades = (low[a, 2] - low[b, 2])[near] / away[near]
    grade = max(float(np.sqrt(np.mean(grades**2))), _LEAST_GRADE)
    return GroundUncertainty(grade, missing_m)
