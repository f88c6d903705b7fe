"""What a map's tiles tell of the ground beyond its edge."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from localizer.map.kind import UNKNOWN_HEIGHT_SIGMA_M, Heights, MapKind
from localizer.map.terrain import ground_uncertainty
from localizer.types import GroundUncertainty


def tiles(side: int, rise: float) -> Any:
    """Tiles of 100 m on hills whose root mean square of rise over distance is about `rise`."""
    east, north = (100.0 * g.ravel() for g in np.meshgrid(np.arange(side), np.arange(side)))
    low = np.column_stack([east, north, rise * 1.5 * 200 * np.sin(east / 200)])
    nodes = np.vstack([low.min(axis=0), low])
    children = np.array([len(low), *[0] * len(low)])
    top = nodes + np.array([100.0, 100.0, 5.0])
    top[:, 2] += np.random.default_rng(0).uniform(0, 30, len(nodes))  # what stands on it
    return SimpleNamespace(box_min=nodes, box_max=top, child_count=children)


def kind(heights: Heights = "surface") -> MapKind:
    return MapKind(heights, UNKNOWN_HEIGHT_SIGMA_M[heights], 0.2)


def test_the_grade_is_that_of_the_ground_and_not_of_what_stands_on_it():
    assert ground_uncertainty(tiles(10, 0.1), kind()).grade == pytest.approx(0.1, rel=0.35)
    assert ground_uncertainty(tiles(60, 0.1), kind()).grade == pytest.approx(0.1, rel=0.35)
    assert ground_uncertainty(tiles(10, 0.0), kind()).grade == 0.03


def test_a_map_that_says_nothing_of_the_ground_stands_for_hills():
    hills = GroundUncertainty().grade
    assert ground_uncertainty(tiles(2, 0.0), kind()).grade == hills
    assert ground_uncertainty(tiles(10, 0.0), kind("flat")).grade == hills
    assert ground_uncertainty(tiles(10, 0.1), kind("terrain")).missing_m == 3.0
