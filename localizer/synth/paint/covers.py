"""What the painting kernels share: covers, facade styles, light, and how a texel is coloured.

Every texel knows its place in the world, and noise is a hash of that place, so textures do not
repeat, tiles join without seams, and two visits differ only in what the `VisitLook` says. Colours
are sRGB values used as albedo; light is ``sky * ambient_occlusion + sun * cos(angle) * lit``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from localizer.types import Image


class Cover(IntEnum):
    """What a building surface is made of; the kernel knows each by this number."""

    PLAIN = 0
    FACADE = 1
    TILES = 2
    GRAVEL = 3
    BITUMEN = 4
    METAL = 5
    GREEN = 6
    GLASS = 7
    DECK = 8  # car-park deck with bays
    SLATE = 9
    HEDGE = 10


class FacadeStyle(IntEnum):
    """Window layout and wall structure of a facade."""

    HOUSE = 0
    APARTMENT = 1
    HALL = 2
    CHURCH = 3
    OFFICE = 4
    BARN = 5
    BLANK = 6
    BRICK = 7


@dataclass(frozen=True)
class WindowLight:
    """Light of one window of the world. ceiling: (h, w) float32 height below which a point is in
    shadow; ambient: (h, w) float32 visible share of the sky at the ground; top-left corner (west,
    north), `gsd_m` per pixel; sun: unit vector (3,); season: dryness, crop, leaf.
    """

    ceiling: NDArray[np.float32]
    ambient: NDArray[np.float32]
    west: float
    north: float
    gsd_m: float
    sun: NDArray[np.float32]
    sun_rgb: NDArray[np.float32]
    sky_rgb: NDArray[np.float32]
    season: NDArray[np.float32]


def new_image(height: int, width: int) -> Image:
    """An RGB image to paint all over: its pixels are arbitrary."""
    return np.empty((height, width, 3), np.uint8)
