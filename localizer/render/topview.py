"""Renders the map from above, square by square."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.render.base import MapRenderer
from localizer.render.holes import fill_holes
from localizer.types import Float32, Image

# Camera axes: x east, y south, z down.
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])

# The eye's height over the map: a tower of 50 m at the edge of a square leans by less than half a
# metre, and float32 depth is still good to 2 mm.
_EYE_M = 20_000.0


@dataclass(frozen=True)
class TopView:
    """A square from above, north up. rgb: (n, n, 3) uint8, holes filled; height: (n, n) float32
    world z, NaN without map.
    """

    rgb: Image
    height: Float32


def render_top_view(
    renderer: MapRenderer, centre: Array, side_px: int, gsd_m: float, base_m: float
) -> TopView:
    """Render the square about `centre` (2,), world m east and north, of side_px pixels of gsd_m
    metres; base_m: lowest world z of the map. Waits until all its tiles are read.
    """
    focal = _EYE_M / gsd_m
    camera = Camera(side_px, side_px, focal, focal, side_px / 2, side_px / 2)
    eye = base_m + _EYE_M
    view = renderer.render(Pose(DOWN, np.array([*centre, eye])), camera, wait=True)
    height = np.where(view.depth > 0, eye - view.depth, np.nan).astype(np.float32)
    return TopView(fill_holes(view), height)
