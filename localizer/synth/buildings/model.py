"""Buildings: footprint with a kind, and planar surfaces to paint and mesh."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from localizer.geometry.pose import Array

LEAF, MID, TOP, ROOT = 1, 2, 4, 8  # bits: levels of detail that show a surface
ALL_LEVELS = LEAF | MID | TOP | ROOT
NEAR_LEVELS = LEAF | MID

Colour = tuple[float, float, float]


class Kind(Enum):
    """Building types."""

    GABLE = "gable"
    HIP = "hip"
    L_GABLE = "l_gable"
    ROW = "row"
    FLAT = "flat"
    TOWER = "tower"
    OFFICE = "office"
    HALL = "hall"
    SAWTOOTH = "sawtooth"
    BARN = "barn"
    SHED = "shed"
    CHURCH = "church"
    SILO = "silo"
    TENT = "tent"
    DECK = "deck"
    CONTAINER = "container"


@dataclass(frozen=True)
class Building:
    """A footprint: length along the axis, width across it, metres; `angle` from east, radians.

    base_z: height of the ground floor; foot_z: where walls end below the ground; eaves_m: wall
    height above the floor.
    """

    kind: Kind
    centre: tuple[float, float]
    angle: float
    length: float
    width: float
    eaves_m: float
    base_z: float
    foot_z: float
    seed: int

    def corners(self, margin: float = 0.0) -> Array:
        """Footprint (4, 2) ENU, grown by a margin."""
        return rectangle(self.centre, self.angle, self.length, self.width, margin)


@dataclass(frozen=True)
class Surface:
    """A flat convex polygon (K, 3) ENU, counter-clockwise from outside, and how it is painted.

    right, down: unit vectors of the texture; normal = cross(down, right). extent: width and length
    of the texture in metres from `origin`.
    """

    polygon: Array
    origin: Array
    right: Array
    down: Array
    normal: Array
    extent: tuple[float, float]
    cover: int
    base: Array
    accent: Array
    params: Array
    floor_z: float
    eaves_z: float
    seed: int
    levels: int


def rectangle(
    centre: ArrayLike, angle: float, length: float, width: float, margin: float = 0.0
) -> Array:
    """Corners (4, 2) of a rectangle, counter-clockwise; angle of its length from east (rad);
    metres.
    """
    c, s = np.cos(angle), np.sin(angle)
    a, b = length / 2 + margin, width / 2 + margin
    local = np.array([[-a, -b], [a, -b], [a, b], [-a, b]])
    corners: Array = local @ np.array([[c, s], [-s, c]]) + np.asarray(centre)
    return corners
