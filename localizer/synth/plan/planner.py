"""The plan of a world, and what planning any cell needs: free ground, frontages, rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from localizer.geometry.pose import Array
from localizer.synth.buildings.shell import Building, Kind, rectangle
from localizer.synth.config import WorldConfig
from localizer.synth.paint.ground_plan import GroundPlan, Material, PlanShape, Regions
from localizer.synth.plan.streets import Street, StreetNet, resample
from localizer.synth.plan.terrain import Terrain


class Zone(Enum):
    """Use of a lattice cell."""

    CENTRE = "centre"
    HOUSES = "houses"
    BLOCKS = "blocks"
    INDUSTRY = "industry"
    PARK = "park"
    SPORTS = "sports"
    CARPARK = "carpark"
    CHURCH = "church"
    FIELD = "field"
    FOREST = "forest"
    MEADOW = "meadow"
    ORCHARD = "orchard"
    FARM = "farm"
    RIVERSIDE = "riverside"


URBAN = {Zone.CENTRE, Zone.HOUSES, Zone.BLOCKS, Zone.INDUSTRY, Zone.PARK, Zone.SPORTS,
         Zone.CARPARK, Zone.CHURCH}  # fmt: skip


@dataclass(frozen=True)
class Trees:
    """Arrays of length N: position (N, 2) ENU, crown radius, height, species (0 broadleaf,
    1 conifer, 2 fruit tree or shrub), dense (stands in a wood: simpler mesh), seed.
    """

    xy: Array
    radius: Array
    height: Array
    species: NDArray[np.int64]
    dense: NDArray[np.bool_]
    seed: NDArray[np.int64]


@dataclass(frozen=True)
class Hedge:
    """A straight hedge from `a` to `b` (2,), metres."""

    a: Array
    b: Array
    width: float
    height: float
    seed: int


@dataclass(frozen=True)
class PlannedTarget:
    """A named static point on a surface, ENU metres (3,)."""

    name: str
    position: Array


@dataclass(frozen=True)
class WorldPlan:
    """Everything static, before it is meshed and painted. slots: (N, 4) parking places: x, y,
    heading, readiness (share of visits at which it tends to be taken). sites: free ground where
    something may be built later."""

    config: WorldConfig
    terrain: Terrain
    regions: Regions
    shapes: list[PlanShape]
    buildings: list[Building]
    trees: Trees
    hedges: list[Hedge]
    slots: Array
    targets: tuple[PlannedTarget, ...]
    roads: tuple[Array, ...]
    sites: tuple[Building, ...] = ()


_OCCUPANCY_GSD_M = 0.5
LAYER_BASE, LAYER_PLOT, LAYER_GARDEN, LAYER_WATER, LAYER_PATH = 0, 1, 2, 10, 20


CROSS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


class Occupancy:
    """A raster of occupied ground: streets, water, buildings."""

    def __init__(self, config: WorldConfig) -> None:
        self.half = config.half_m + 20.0
        n = int(2 * self.half / _OCCUPANCY_GSD_M)
        self.grid = np.zeros((n, n), np.uint8)

    def _pixels(self, points: ArrayLike) -> NDArray[np.int32]:
        xy = np.asarray(points, float)
        uv = np.stack([xy[:, 0] + self.half, self.half - xy[:, 1]], -1) / _OCCUPANCY_GSD_M
        return np.asarray(np.round(uv - 0.5), np.int32)

    def stroke(self, points: ArrayLike, width_m: float) -> None:
        """Mark a band of width_m along points (N, 2) as occupied."""
        thickness = max(1, round(width_m / _OCCUPANCY_GSD_M))
        cv2.polylines(self.grid, [self._pixels(points)], False, 1, thickness)

    def occupy(self, polygon: ArrayLike, margin: ArrayLike | None = None) -> bool:
        """Occupy a polygon if it (or `margin`, a larger one around it) is free; True if it was."""
        test = self._pixels(polygon if margin is None else margin)
        low, high = test.min(0), test.max(0) + 1
        n = self.grid.shape[0]
        if low.min() < 0 or high.max() > n:
            return False
        window = self.grid[low[1] : high[1], low[0] : high[0]]
        mask = np.zeros_like(window)
        cv2.fillConvexPoly(mask, test - low, 1)
        if (window & mask).any():
            return False
        cv2.fillConvexPoly(self.grid, self._pixels(polygon), 1)
        return True

    def is_free(self, xy: Array, radius: float) -> NDArray[np.bool_]:
        """Which points (N, 2), ENU metres, have nothing within about `radius` metres, and lie
        inside the world: (N,).
        """
        n = self.grid.shape[0]
        uv = self._pixels((xy[:, None] + radius * CROSS).reshape(-1, 2))
        inside = (uv >= 0) & (uv < n)
        uv = np.minimum(np.maximum(uv, 0), n - 1)
        ok = inside[:, 0] & inside[:, 1] & (self.grid[uv[:, 1], uv[:, 0]] == 0)
        return np.asarray(ok.reshape(-1, len(CROSS)).all(axis=1))


@dataclass
class Planner:
    """The state of planning one world. Lengths in metres, angles in radians from east, positions
    ENU.
    """

    config: WorldConfig
    terrain: Terrain
    net: StreetNet
    ground: GroundPlan
    taken: Occupancy
    buildings: list[Building] = field(default_factory=list)
    trees: list[tuple[float, ...]] = field(default_factory=list)
    hedges: list[Hedge] = field(default_factory=list)
    slots: list[tuple[float, float, float, float]] = field(default_factory=list)
    corners: list[Array] = field(default_factory=list)  # corners of painted pitches

    def place(  # noqa: PLR0913
        self, rng: np.random.Generator, kind: Kind, centre: ArrayLike, angle: float, length: float,
        width: float, eaves: float, margin: float = 1.5,
    ) -> Building | None:  # fmt: skip
        """Add a building if it, with `margin` around it, is on free ground in the world; otherwise
        return None. centre: ENU; angle: of its length from east, rad; all lengths in metres. Its
        ground is then occupied.
        """
        c = np.asarray(centre, float)
        polygon = rectangle(c, angle, length, width)
        if np.abs(polygon).max() > self.config.half_m - 4.0:
            return None
        if not self.taken.occupy(polygon, rectangle(c, angle, length, width, margin)):
            return None
        z = self.terrain.height(polygon[:, 0], polygon[:, 1])
        base = float(0.35 * z.min() + 0.65 * z.max()) + 0.15
        building = Building(
            kind, (float(c[0]), float(c[1])), float(angle), float(length), float(width),
            float(eaves), base, float(z.min()) - 0.6, int(rng.integers(1 << 30)),
        )  # fmt: skip
        self.buildings.append(building)
        return building

    def plant_tree(
        self, rng: np.random.Generator, xy: ArrayLike, size: float = 1.0, species: int | None = None
    ) -> None:
        """Add one free-standing tree if there is room for its trunk. size: factor of the usual;
        species: as of `Trees`; None: drawn.
        """
        p = np.asarray(xy, float).reshape(1, 2)
        if not self.taken.is_free(p, 0.8)[0]:
            return
        kind = int(rng.random() < 0.18) if species is None else species
        radius = size * (rng.uniform(1.6, 3.9) if kind == 0 else rng.uniform(1.4, 2.4))
        height = radius * (rng.uniform(1.9, 2.7) if kind == 0 else rng.uniform(3.6, 5.2))
        if kind == 2:
            radius, height = size * rng.uniform(0.7, 1.6), size * rng.uniform(1.1, 2.4)
        self.trees.append((*p[0], radius, height, kind, 0, int(rng.integers(1 << 30))))

    def plant_wood(self, rng: np.random.Generator, polygon: Array, spacing: float, conifers: float
             ) -> None:  # fmt: skip
        """Fill a polygon with trees on a jittered grid. spacing: m; conifers: their share, 0 to
        1.
        """
        low, high = polygon.min(0), polygon.max(0)
        x, y = np.meshgrid(np.arange(low[0], high[0], spacing), np.arange(low[1], high[1], spacing))
        xy = np.stack([x, y], -1).reshape(-1, 2)
        xy = xy + rng.uniform(-0.42, 0.42, xy.shape) * spacing
        outline = polygon.astype(np.float32)
        inside = np.array(
            [cv2.pointPolygonTest(outline, (float(a), float(b)), False) > 0 for a, b in xy], bool
        )
        xy = xy[inside & self.taken.is_free(xy, 2.0)] if len(xy) else xy
        for a, b in xy:
            conifer = rng.random() < conifers
            radius = spacing * (rng.uniform(0.42, 0.62) if conifer else rng.uniform(0.5, 0.78))
            height = rng.uniform(11, 20) if conifer else rng.uniform(8, 15)
            self.trees.append((a, b, radius, height, int(conifer), 1, int(rng.integers(1 << 30))))


def frontages(planner: Planner, i: int, j: int) -> list[tuple[Array, Street]]:
    """The sides of the cell (column i, row j) that face a street: points (N, 2) 1 m apart, ENU,
    with the cell on their left, and the street.
    """
    corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1), (i, j)]
    found = []
    for a, b in pairwise(corners):
        street = planner.net.side(a, b)
        if street is not None:
            line = street.points if a < b else street.points[::-1]
            found.append((resample(line, 1.0), street))
    return found


def main_axis(outline: Array) -> float:
    """Direction (rad) of the first of four sides of equally many points, as of `Lattice.cell`."""
    edge = outline[len(outline) // 4] - outline[0]
    return float(np.arctan2(edge[1], edge[0]))


def line_frame(line: Array, s: int) -> tuple[Array, Array, Array]:
    """Point, tangent and left normal at metre s of a line with points at 1 m steps."""
    a, b = line[max(0, s - 3)], line[min(len(line) - 1, s + 3)]
    tangent = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    return line[s], tangent, np.array([-tangent[1], tangent[0]])


def axis_rows(outline: Array) -> Array:
    """(2, 2): row vectors along and across a cell's axis to ENU."""
    c, s = np.cos(main_axis(outline)), np.sin(main_axis(outline))
    return np.array([[c, s], [-s, c]])


def pair_grid(u: ArrayLike, v: ArrayLike) -> Array:
    """All pairs (N, 2)."""
    return np.stack(np.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)


def scatter_trees(
    planner: Planner, rng: np.random.Generator, outline: Array, count: int, size: float
) -> None:
    """Plant up to `count` trees at random places inside an outline (N, 2). size: mean factor."""
    low, high = outline.min(0), outline.max(0)
    contour = outline.astype(np.float32)
    for xy in rng.uniform(low, high, (count, 2)):
        if cv2.pointPolygonTest(contour, (float(xy[0]), float(xy[1])), False) > 0:
            planner.plant_tree(rng, xy, size * rng.uniform(0.7, 1.3))


def park_rows(
    planner: Planner, rng: np.random.Generator, centre: Array, angle: float, length: float,
    width: float, ready: float,
) -> None:  # fmt: skip
    """Add a car park of double rows if there is room. ready: readiness of its slots
    (`WorldPlan`).
    """
    polygon = rectangle(centre, angle, length, width)
    if not planner.taken.occupy(polygon):
        return
    ground = planner.ground
    ground.polygon(LAYER_PATH, rectangle(centre, angle, length, width, 0.6),
                   ground.region(Material.KERB))  # fmt: skip
    ground.polygon(LAYER_PATH, polygon, ground.region(Material.ASPHALT, angle=angle, vary=0.1))
    mark = ground.region(Material.MARKING)
    c, s = np.cos(angle), np.sin(angle)
    along, across = np.array([c, s]), np.array([-s, c])
    rows = max(1, int(width // 16))
    for k in range(rows):
        middle = (k + 0.5) * width / rows - width / 2
        for sign in (-1.0, 1.0):
            inner, outer = middle + sign * 3.0, middle + sign * 7.8
            bays = int((length - 1) // 2.5)
            for b in range(bays + 1):
                u = (b - bays / 2) * 2.5
                foot = centre + along * u
                ground.stroke(LAYER_PATH + 1, [foot + across * inner, foot + across * outer], 0.13,
                              mark)  # fmt: skip
                if b < bays:
                    spot = centre + along * (u + 1.25) + across * (inner + outer) / 2
                    planner.slots.append((*spot, angle + np.pi / 2, ready))


def bezier(a: Array, b: Array, c: Array) -> Array:
    """Quadratic curve (14, 2) from a to c, drawn towards b."""
    t = np.linspace(0, 1, 14)[:, None]
    return (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t**2 * c
