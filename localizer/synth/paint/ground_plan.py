"""The painted plan of the ground: regions (what covers it) and shapes (where), in paint order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from localizer.geometry.pose import Array

_SHIFT = 4  # fractional bits of OpenCV's fixed-point vertices


class Material(IntEnum):
    """What covers the ground. The painter in `paint.ground` knows each by this number."""

    MEADOW = 0
    LAWN = 1
    ASPHALT = 2
    PAVEMENT = 3  # concrete slabs with joints
    MARKING = 4
    GRAVEL = 5
    CROP = 6  # green rows
    SOIL = 7  # ploughed furrows
    GRAIN = 8  # ripe field with tramlines
    FOREST = 9
    WATER = 10
    TURF = 11  # sports lawn with mowing stripes
    TRACK = 12  # red running track
    PAVING = 13  # small stones
    BED = 14  # garden bed, shrubs
    CONCRETE = 15
    KERB = 16
    BANK = 17  # stones and reed beside water
    POOL = 18


@dataclass(frozen=True)
class Regions:
    """Tables by region id: material (R,) uint8, tint (R, 3) float32 as a factor, and shape (R, 3)
    float32: direction of rows in radians, spacing in metres, seed.
    """

    material: NDArray[np.uint8]
    tint: NDArray[np.float32]
    shape: NDArray[np.float32]


@dataclass(frozen=True)
class PlanShape:
    """A polygon (width 0) or a stroke of a line with round joins; points (N, 2) ENU metres."""

    points: Array
    width_m: float
    region: int


@dataclass
class GroundPlan:
    """Collects regions and shapes; later shapes lie over earlier ones within a layer."""

    rng: np.random.Generator
    _material: list[int] = field(default_factory=list)
    _tint: list[Array] = field(default_factory=list)
    _shape: list[tuple[float, float, float]] = field(default_factory=list)
    _layers: dict[int, list[PlanShape]] = field(default_factory=dict)

    def region(
        self, material: Material, *, angle: float = 0.0, spacing: float = 1.0, vary: float = 0.06
    ) -> int:
        """Add a region with its own tint (standard deviation `vary`) and seed; returns its id.
        angle (rad) and spacing (m): of rows.
        """
        grey = self.rng.normal(0, vary)
        tint = np.clip(1 + grey + self.rng.normal(0, vary / 3, 3), 0.55, 1.5)
        self._material.append(int(material))
        self._tint.append(tint)
        self._shape.append((angle, spacing, float(self.rng.integers(0, 1 << 16))))
        return len(self._material) - 1

    def polygon(self, layer: int, points: ArrayLike, region: int) -> None:
        """Add an area (N, 2), ENU m, of a region to a layer."""
        self._layers.setdefault(layer, []).append(PlanShape(np.asarray(points, float), 0.0, region))

    def stroke(self, layer: int, points: ArrayLike, width_m: float, region: int) -> None:
        """Add a line (N, 2), ENU m, of a width and region to a layer."""
        self._layers.setdefault(layer, []).append(
            PlanShape(np.asarray(points, float), width_m, region)
        )

    def regions(self) -> Regions:
        """The properties of all regions so far, as arrays by region number."""
        return Regions(
            np.array(self._material, np.uint8),
            np.array(self._tint, np.float32),
            np.array(self._shape, np.float32),
        )

    def shapes(self) -> list[PlanShape]:
        """All shapes, bottom layer first."""
        return [shape for layer in sorted(self._layers) for shape in self._layers[layer]]


def shape_bounds(shapes: list[PlanShape]) -> Array:
    """(S, 4) west, south, east, north of every shape with its width."""
    rows = []
    for shape in shapes:
        low = shape.points.min(0) - shape.width_m / 2
        high = shape.points.max(0) + shape.width_m / 2
        rows.append((*low, *high))
    return np.array(rows).reshape(-1, 4)


def rasterize(
    shapes: Iterable[PlanShape], west: float, north: float, gsd_m: float, shape: tuple[int, int]
) -> NDArray[np.uint16]:
    """Region ids (H, W) of a window whose top-left corner is (west, north); 0 under no shape."""
    out = np.zeros(shape, np.uint16)
    one = 1 << _SHIFT
    for item in shapes:
        # OpenCV's pixel centres are integers: half a pixel less than here.
        u = (item.points[:, 0] - west) / gsd_m - 0.5
        v = (north - item.points[:, 1]) / gsd_m - 0.5
        points = np.round(np.stack([u, v], -1) * one).astype(np.int32)
        if item.width_m:
            thickness = max(1, round(item.width_m / gsd_m))
            cv2.polylines(out, [points], False, item.region, thickness, cv2.LINE_8, _SHIFT)
        else:
            cv2.fillPoly(out, [points], item.region, cv2.LINE_8, _SHIFT)
    return out
