"""The plan of a world: what stands where. Made once per seed; every visit paints the same plan."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from localizer.pose import Array
from localizer.synth.buildings import Building, Kind, Surface, build, rectangle
from localizer.synth.config import WorldConfig
from localizer.synth.ground import GroundPlan, Material, Regions, Shape
from localizer.synth.streets import (
    LAYER_KERB,
    Lattice,
    Street,
    StreetNet,
    cut_ends,
    make_lattice,
    make_streets,
    offset_line,
    paint_streets,
    resample,
)
from localizer.synth.terrain import Terrain, make_terrain

_OCCUPANCY_GSD_M = 0.5
LAYER_BASE, LAYER_PLOT, LAYER_GARDEN, LAYER_WATER, LAYER_PATH = 0, 1, 2, 10, 20


_CROSS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


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
class Target:
    """A named static point on a surface, ENU metres (3,)."""

    name: str
    position: Array


@dataclass(frozen=True)
class WorldPlan:
    """Everything static, before it is meshed and painted. slots: (N, 4) parking places: x, y,
    heading, readiness (share of visits at which it tends to be taken)."""

    config: WorldConfig
    terrain: Terrain
    regions: Regions
    shapes: list[Shape]
    buildings: list[Building]
    trees: Trees
    hedges: list[Hedge]
    slots: Array
    targets: tuple[Target, ...]
    roads: tuple[Array, ...]


class _Occupancy:
    """A raster of what is taken: streets, water, buildings."""

    def __init__(self, config: WorldConfig) -> None:
        self.half = config.half_m + 20.0
        n = int(2 * self.half / _OCCUPANCY_GSD_M)
        self.grid = np.zeros((n, n), np.uint8)

    def _pixels(self, points: ArrayLike) -> NDArray[np.int32]:
        xy = np.asarray(points, float)
        uv = np.stack([xy[:, 0] + self.half, self.half - xy[:, 1]], -1) / _OCCUPANCY_GSD_M
        return np.asarray(np.round(uv - 0.5), np.int32)

    def stroke(self, points: ArrayLike, width_m: float) -> None:
        thickness = max(1, round(width_m / _OCCUPANCY_GSD_M))
        cv2.polylines(self.grid, [self._pixels(points)], False, 1, thickness)

    def claim(self, polygon: ArrayLike, margin: ArrayLike | None = None) -> bool:
        """Take a polygon if it (or `margin`, a larger one around it) is free."""
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

    def free(self, xy: Array, radius: float) -> NDArray[np.bool_]:
        """Which points (N, 2) have nothing within about `radius`, and lie inside the world."""
        n = self.grid.shape[0]
        uv = self._pixels((xy[:, None] + radius * _CROSS).reshape(-1, 2))
        inside = (uv >= 0) & (uv < n)
        uv = np.minimum(np.maximum(uv, 0), n - 1)
        ok = inside[:, 0] & inside[:, 1] & (self.grid[uv[:, 1], uv[:, 0]] == 0)
        return np.asarray(ok.reshape(-1, len(_CROSS)).all(axis=1))


@dataclass
class _Planner:
    """The state of planning one world."""

    config: WorldConfig
    terrain: Terrain
    net: StreetNet
    ground: GroundPlan
    taken: _Occupancy
    buildings: list[Building] = field(default_factory=list)
    trees: list[tuple[float, ...]] = field(default_factory=list)
    hedges: list[Hedge] = field(default_factory=list)
    slots: list[tuple[float, float, float, float]] = field(default_factory=list)
    corners: list[Array] = field(default_factory=list)  # corners of painted pitches

    def place(
        self, rng: np.random.Generator, kind: Kind, centre: ArrayLike, angle: float, length: float,
        width: float, eaves: float, margin: float = 1.5,
    ) -> Building | None:  # fmt: skip
        """Put a building if its ground is free and inside the world."""
        c = np.asarray(centre, float)
        polygon = rectangle(c, angle, length, width)
        if np.abs(polygon).max() > self.config.half_m - 4.0:
            return None
        if not self.taken.claim(polygon, rectangle(c, angle, length, width, margin)):
            return None
        z = self.terrain.height(polygon[:, 0], polygon[:, 1])
        base = float(0.35 * z.min() + 0.65 * z.max()) + 0.15
        building = Building(
            kind, (float(c[0]), float(c[1])), float(angle), float(length), float(width),
            float(eaves), base, float(z.min()) - 0.6, int(rng.integers(1 << 30)),
        )  # fmt: skip
        self.buildings.append(building)
        return building

    def tree(
        self, rng: np.random.Generator, xy: ArrayLike, size: float = 1.0, species: int | None = None
    ) -> None:
        """Put one free-standing tree if there is room for its trunk."""
        p = np.asarray(xy, float).reshape(1, 2)
        if not self.taken.free(p, 0.8)[0]:
            return
        kind = int(rng.random() < 0.18) if species is None else species
        radius = size * (rng.uniform(1.6, 3.9) if kind == 0 else rng.uniform(1.4, 2.4))
        height = radius * (rng.uniform(1.9, 2.7) if kind == 0 else rng.uniform(3.6, 5.2))
        if kind == 2:
            radius, height = size * rng.uniform(0.7, 1.6), size * rng.uniform(1.1, 2.4)
        self.trees.append((*p[0], radius, height, kind, 0, int(rng.integers(1 << 30))))

    def wood(self, rng: np.random.Generator, polygon: Array, spacing: float, conifers: float
             ) -> None:  # fmt: skip
        """Fill a polygon with trees on a jittered grid."""
        low, high = polygon.min(0), polygon.max(0)
        x, y = np.meshgrid(np.arange(low[0], high[0], spacing), np.arange(low[1], high[1], spacing))
        xy = np.stack([x, y], -1).reshape(-1, 2)
        xy = xy + rng.uniform(-0.42, 0.42, xy.shape) * spacing
        outline = polygon.astype(np.float32)
        inside = np.array(
            [cv2.pointPolygonTest(outline, (float(a), float(b)), False) > 0 for a, b in xy], bool
        )
        xy = xy[inside & self.taken.free(xy, 2.0)] if len(xy) else xy
        for a, b in xy:
            conifer = rng.random() < conifers
            radius = spacing * (rng.uniform(0.42, 0.62) if conifer else rng.uniform(0.5, 0.78))
            height = rng.uniform(11, 20) if conifer else rng.uniform(8, 15)
            self.trees.append((a, b, radius, height, int(conifer), 1, int(rng.integers(1 << 30))))


def _zones(config: WorldConfig, lattice: Lattice, terrain: Terrain
           ) -> dict[tuple[int, int], Zone]:  # fmt: skip
    """Use of every cell that touches the world."""
    rng = config.rng(12)
    small = config.size_m < 1000
    radius = config.town_radius_m
    if radius is None:
        radius = rng.uniform(0.2, 1.1) * config.size_m if small else 0.38 * config.size_m
    centre = rng.uniform(-0.3, 0.3, 2) * config.size_m if small else rng.uniform(-80, 80, 2)
    industry = rng.uniform(0, 2 * np.pi)
    wave = rng.uniform(0, 2 * np.pi, 4)
    zones: dict[tuple[int, int], Zone] = {}
    distance: dict[tuple[int, int], float] = {}
    for i in range(len(lattice.u) - 1):
        for j in range(len(lattice.v) - 1):
            outline = lattice.cell(i, j)
            if np.abs(outline).max(1).min() > config.half_m + 30:
                continue
            p = lattice.centre(i, j)
            d = float(np.linalg.norm(p - centre))
            lobe = 1 + 0.22 * np.sin(3 * np.arctan2(*(p - centre)) + wave[0])
            near = d / (radius * lobe)
            away, index = terrain.river.distance(outline)
            draw, patch = rng.random(), np.sin(p[0] / 150 + wave[1]) + np.sin(p[1] / 170 + wave[2])
            bearing = np.arctan2(p[1] - centre[1], p[0] - centre[0]) - industry
            if (away < terrain.river.width[index] / 2 + 10).any():
                zone = Zone.RIVERSIDE
            elif near < 0.26:
                zone = Zone.CENTRE if draw < 0.8 else Zone.BLOCKS
            elif 0.55 < near < 1.02 and np.cos(bearing) > 0.86:
                zone = Zone.INDUSTRY
            elif near < 1.0:
                zone = (
                    Zone.HOUSES if draw < 0.80 else Zone.BLOCKS if draw < 0.90
                    else Zone.PARK if draw < 0.95 else Zone.SPORTS if draw < 0.98 else Zone.CARPARK
                )  # fmt: skip
            elif patch > 0.75:
                zone = Zone.FOREST
            else:
                zone = (
                    Zone.FIELD if draw < 0.66 else Zone.MEADOW if draw < 0.80
                    else Zone.ORCHARD if draw < 0.90 else Zone.FARM
                )  # fmt: skip
            zones[i, j], distance[i, j] = zone, d
    if radius > 150:
        _give_landmarks(zones, distance)
    return zones


def _give_landmarks(
    zones: dict[tuple[int, int], Zone], distance: dict[tuple[int, int], float]
) -> None:
    """A church, a car park, a sports ground and a park near the middle of the town."""
    order = sorted((c for c in zones if zones[c] is not Zone.RIVERSIDE), key=distance.__getitem__)
    for rank, zone in ((1, Zone.CHURCH), (2, Zone.CARPARK), (5, Zone.SPORTS), (7, Zone.PARK),
                       (9, Zone.BLOCKS), (14, Zone.SPORTS)):  # fmt: skip
        if rank < len(order) and zones[order[rank]] in URBAN:
            zones[order[rank]] = zone


def _raise_bridges(terrain: Terrain, net: StreetNet) -> Terrain:
    """Carry streets over the river on causeways: water is not on the way of any wheel."""
    heights = terrain.heights.copy()
    n, step, half = heights.shape[0], terrain.spacing_m, terrain.half_m
    axis = np.linspace(-half, half, n)
    x, y = np.meshgrid(axis, axis)
    grid = np.stack([x, y], -1)
    for street in net.streets:
        line = resample(street.points, 2.0)
        distance, nearest = terrain.river.distance(line)
        wet = distance < terrain.river.width[nearest] / 2 + 14
        for p, k in zip(line[wet], nearest[wet], strict=True):
            reach = street.reach_m + step
            c0, c1 = ((p[0] + half - reach) / step, (p[0] + half + reach) / step + 1)
            r0, r1 = ((p[1] + half - reach) / step, (p[1] + half + reach) / step + 1)
            window = np.s_[max(0, int(r0)) : max(0, int(r1) + 1),
                           max(0, int(c0)) : max(0, int(c1) + 1)]  # fmt: skip
            near = np.linalg.norm(grid[window] - p, axis=-1) < reach
            level = terrain.river.level[k] + 2.0
            heights[window] = np.where(
                near, np.maximum(heights[window], level), heights[window]
            ).astype(np.float32)
    return replace(terrain, heights=heights)


def plan_world(config: WorldConfig) -> WorldPlan:
    """Everything that stands in the world of this seed and size."""
    terrain = make_terrain(config)
    lattice = make_lattice(config)
    zones = _zones(config, lattice, terrain)
    net = make_streets(config, terrain, {c: z in URBAN for c, z in zones.items()}, lattice)
    terrain = _raise_bridges(terrain, net)
    planner = _Planner(config, terrain, net, GroundPlan(config.rng(13)), _Occupancy(config))
    planner.ground.region(Material.MEADOW)  # region 0: what nothing else covers
    for street in net.streets:
        planner.taken.stroke(street.points, 2 * street.reach_m + 0.6)
    _paint_water(planner)
    paint_streets(net, planner.ground)
    fields: dict[tuple[int, int, int], int] = {}
    for (i, j), zone in zones.items():
        _plan_cell(planner, config.rng(20, i + 500, j + 500), i, j, zone, zones, fields)
    _park_along_streets(planner, config.rng(14), zones)
    _plant_street_trees(planner, config.rng(15))
    return _finish(planner)


def _finish(planner: _Planner) -> WorldPlan:
    config, terrain = planner.config, planner.terrain
    table = np.array(planner.trees, float).reshape(-1, 7)
    table = table[np.abs(table[:, :2]).max(1) < config.half_m - 3.0]
    trees = Trees(
        table[:, :2], table[:, 2], table[:, 3], table[:, 4].astype(int), table[:, 5] > 0,
        table[:, 6].astype(int),
    )  # fmt: skip
    slots = np.array(planner.slots, float).reshape(-1, 4)
    slots = slots[np.abs(slots[:, :2]).max(1) < config.half_m - 5.0]
    hedges = [
        h for h in planner.hedges if max(np.abs(h.a).max(), np.abs(h.b).max()) < config.half_m - 2
    ]
    return WorldPlan(
        config, terrain, planner.ground.regions(), planner.ground.shapes(), planner.buildings,
        trees, hedges, slots, _targets(planner), _roads(planner),
    )  # fmt: skip


def _roads(planner: _Planner) -> tuple[Array, ...]:
    """Main roads as drivable lines (N, 3), longest first."""
    limit = planner.config.half_m - 25.0
    roads = []
    for line in planner.net.main_lines:
        inside = np.abs(line).max(1) < limit
        if not inside.any():
            continue
        first, last = np.flatnonzero(inside)[[0, -1]]
        run = line[first : last + 1]
        run = run[np.abs(run).max(1) < limit]
        if len(run) < 10:
            continue
        lane = resample(offset_line(run, -2.2), 4.0)  # right-hand lane
        z = planner.terrain.height(lane[:, 0], lane[:, 1])
        roads.append(np.column_stack([lane, z]))
    roads.sort(key=lambda r: -len(r))
    return tuple(roads)


def _targets(planner: _Planner) -> tuple[Target, ...]:
    """Static points near the middle: a crossing, a flat roof, a corner of a pitch (or a node)."""
    terrain, net = planner.terrain, planner.net
    degree = np.bincount([n for s in net.streets for n in (s.a, s.b)], minlength=len(net.nodes))
    rank = np.bincount([n for s in net.streets if s.rank == 0 for n in (s.a, s.b)],
                       minlength=len(net.nodes))  # fmt: skip
    score = np.linalg.norm(net.nodes, axis=1) + 400.0 * (rank < 4) + 900.0 * (degree < 3)
    crossing = net.nodes[int(np.argmin(score))]
    points = [("crossing", _on_ground(terrain, crossing))]

    roof = _roof_point(planner.buildings)
    if roof is not None:
        points.append(("roof", roof))
    corners = planner.corners or [net.nodes[int(np.argsort(score)[1])]]
    pitch = min(corners, key=lambda c: float(np.linalg.norm(c)))
    points.append(("pitch corner", _on_ground(terrain, pitch)))
    return tuple(Target(name, p) for name, p in points)


def _roof_point(buildings: list[Building]) -> Array | None:
    """A point on a flat roof, 3 m inside its corner: at the very edge a pixel's ray that is a
    little off would miss the roof and hit the ground far behind.
    """
    kinds = (Kind.OFFICE, Kind.DECK, Kind.FLAT, Kind.HALL)
    flat = [b for b in buildings if b.kind in kinds]
    for building in sorted(flat, key=lambda b: abs(float(np.hypot(*b.centre)) - 150.0)):
        surfaces = build(building)
        for corner in rectangle(
            building.centre, building.angle, building.length - 6.0, building.width - 6.0
        ):
            z = [_height_over(surfaces, corner + 1.2 * step) for step in _CROSS]
            if np.ptp(z) < 0.02 and z[0] > building.base_z + 2.0:
                return np.array([*corner, z[0]])
    return None


def _height_over(surfaces: list[Surface], xy: Array) -> float:
    """Height of the highest surface over a point (2,), -inf where there is none."""
    best = -np.inf
    for surface in surfaces:
        if surface.normal[2] < 1e-3:
            continue
        outline = surface.polygon[:, :2].astype(np.float32)
        if cv2.pointPolygonTest(outline, (float(xy[0]), float(xy[1])), False) >= 0:
            p, n = surface.polygon[0], surface.normal
            best = max(best, float(p[2] - ((xy - p[:2]) @ n[:2]) / n[2]))
    return best


def _on_ground(terrain: Terrain, xy: Array) -> Array:
    return np.array([xy[0], xy[1], float(terrain.height(xy[0], xy[1]))])


def _paint_water(planner: _Planner) -> None:
    river, ground = planner.terrain.river, planner.ground
    bank = ground.region(Material.BANK)
    heading = river.points[-1] - river.points[0]
    water = ground.region(Material.WATER, angle=float(np.arctan2(heading[1], heading[0])))
    for extra, region, layer in ((7.0, bank, LAYER_WATER), (0.0, water, LAYER_WATER + 1)):
        for k in range(0, len(river.points) - 1):
            width = float(river.width[k]) + extra
            ground.stroke(layer, river.points[k : k + 2], width, region)
    for k in range(len(river.points) - 1):
        planner.taken.stroke(river.points[k : k + 2], float(river.width[k]) + 7.0)
    for street in planner.net.streets:
        distance, nearest = river.distance(street.points)
        if (distance < river.width[nearest] / 2 + 14).any():
            ground.stroke(LAYER_KERB - 3, street.points, 2 * street.reach_m + 5.0, bank)


def _frontages(planner: _Planner, i: int, j: int) -> list[tuple[Array, Street]]:
    """The sides of a cell that face a street: line (N, 2) at 1 m with the cell on its left."""
    corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1), (i, j)]
    found = []
    for a, b in pairwise(corners):
        street = planner.net.side(a, b)
        if street is not None:
            line = street.points if a < b else street.points[::-1]
            found.append((resample(line, 1.0), street))
    return found


def _plan_cell(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, zone: Zone,
    zones: dict[tuple[int, int], Zone], fields: dict[tuple[int, int, int], int],
) -> None:  # fmt: skip
    outline = planner.net.lattice.cell(i, j)
    base = {
        Zone.CENTRE: Material.PAVING, Zone.HOUSES: Material.LAWN, Zone.BLOCKS: Material.LAWN,
        Zone.INDUSTRY: Material.CONCRETE, Zone.PARK: Material.LAWN, Zone.SPORTS: Material.LAWN,
        Zone.CARPARK: Material.LAWN, Zone.CHURCH: Material.PAVING, Zone.FOREST: Material.FOREST,
    }.get(zone, Material.MEADOW)  # fmt: skip
    angle = _axis(outline)
    if zone is not Zone.FIELD:
        region = planner.ground.region(base, angle=angle)
        planner.ground.polygon(LAYER_BASE, outline, region)
    if zone is Zone.FIELD:
        _plan_field(planner, rng, i, j, fields)
    else:
        _CELLS[zone](planner, rng, i, j, outline)
    if zone in (Zone.MEADOW, Zone.FIELD, Zone.ORCHARD):
        _hedgerow(planner, rng, i, j)


def _axis(outline: Array) -> float:
    edge = outline[8] - outline[0]
    return float(np.arctan2(edge[1], edge[0]))


def _frame(line: Array, s: int) -> tuple[Array, Array, Array]:
    """Point, tangent and left normal of a line at metre s."""
    a, b = line[max(0, s - 3)], line[min(len(line) - 1, s + 3)]
    tangent = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    return line[s], tangent, np.array([-tangent[1], tangent[0]])


def _plan_houses(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    rows = rng.random() < 0.22
    for line, street in _frontages(planner, i, j):
        s = int(street.reach_m + rng.uniform(7, 10))
        while s < len(line) - 12:
            lot = rng.uniform(15.5, 22.0)
            if rows:
                lot = rng.uniform(24, 40)
            middle = int(s + lot / 2)
            if middle >= len(line) - 8:
                break
            _plan_plot(planner, rng, line, middle, lot, street, rows, outline.mean(0))
            s += int(lot)
    _plan_interior(planner, rng, outline)
    _scatter_trees(planner, rng, outline, int(rng.integers(14, 34)), 0.75)


def _plan_interior(planner: _Planner, rng: np.random.Generator, outline: Array) -> None:
    """The middle of a residential block: allotments, a second row of houses, or an orchard."""
    use = rng.random()
    if use < 0.45:
        _plan_allotments(planner, rng, outline)
    elif use < 0.8:
        _plan_second_row(planner, rng, outline)
    else:
        for local in _grid(np.arange(-14, 15, 6.0), np.arange(-12, 13, 5.5)):
            planner.tree(rng, outline.mean(0) + local @ _turn(outline), rng.uniform(0.9, 1.5), 2)


def _turn(outline: Array) -> Array:
    """(2, 2): row vectors along and across a cell's axis to ENU."""
    c, s = np.cos(_axis(outline)), np.sin(_axis(outline))
    return np.array([[c, s], [-s, c]])


def _grid(u: ArrayLike, v: ArrayLike) -> Array:
    """All pairs (N, 2)."""
    return np.stack(np.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)


def _plan_allotments(planner: _Planner, rng: np.random.Generator, outline: Array) -> None:
    angle, middle, frame = _axis(outline), outline.mean(0), _turn(outline)
    ground = planner.ground
    lane = ground.region(Material.GRAVEL, vary=0.1)
    ground.polygon(LAYER_GARDEN, rectangle(middle, angle, 37, 27), lane)
    for local in _grid(np.arange(-15, 16, 7.5), (-9.6, -3.6, 3.6, 9.6)):
        at = middle + local @ frame
        cover = Material(rng.choice([Material.LAWN, Material.SOIL, Material.CROP, Material.BED]))
        plot = ground.region(cover, angle=angle, spacing=rng.uniform(0.7, 1.1), vary=0.12)
        ground.polygon(LAYER_GARDEN, rectangle(at, angle, 6.7, 5.4), plot)
        bed = ground.region(Material.BED, vary=0.12)
        side = at + np.array([0.0, 1.7]) @ frame
        ground.polygon(LAYER_GARDEN, rectangle(side, angle, 5.5, 1.6), bed)
        if rng.random() < 0.6:
            corner = at + rng.uniform(-1, 1, 2)
            planner.place(rng, Kind.SHED, corner, angle, 3.0, 2.5, 2.1, 0.2)
        elif rng.random() < 0.5:
            planner.tree(rng, at, 1.0, 2)


def _plan_second_row(planner: _Planner, rng: np.random.Generator, outline: Array) -> None:
    angle, middle, frame = _axis(outline), outline.mean(0), _turn(outline)
    ground = planner.ground
    for _ in range(6):
        at = middle + rng.uniform(-15, 15, 2) @ frame
        kind = Kind(rng.choice(["gable", "hip", "flat", "l_gable"]))
        turn = angle + rng.choice([0.0, np.pi / 2])
        length, width, eaves = rng.uniform(9, 13), rng.uniform(8.5, 11), rng.uniform(3.0, 6.5)
        house = planner.place(rng, kind, at, turn, length, width, eaves, 4.0)
        if house is None:
            continue
        plot = ground.region(Material.LAWN, angle=turn, vary=0.12)
        ground.polygon(LAYER_PLOT, rectangle(at, turn, 20, 19), plot)
        patio = ground.region(Material.PAVING, angle=turn, vary=0.1)
        ground.polygon(LAYER_GARDEN, house.corners(1.3), patio)
    lane = ground.region(Material.ASPHALT if rng.random() < 0.5 else Material.GRAVEL)
    end = middle + (middle - outline[4]) * 0.3
    ground.stroke(LAYER_GARDEN, _curve(outline[4], middle, end), 3.0, lane)


def _plan_plot(
    planner: _Planner, rng: np.random.Generator, line: Array, s: int, lot: float, street: Street,
    row: bool, middle: Array,
) -> None:  # fmt: skip
    p, tangent, normal = _frame(line, s)
    angle = float(np.arctan2(tangent[1], tangent[0]))
    front = street.reach_m
    if row:
        kind, length, width = Kind.ROW, lot - rng.uniform(3, 6), rng.uniform(9, 11)
    else:
        kind = Kind(rng.choice(["gable", "hip", "l_gable", "flat"], p=[0.5, 0.22, 0.18, 0.10]))
        length, width = rng.uniform(9.5, 13.5), rng.uniform(8, 10.5)
        if kind is Kind.L_GABLE:
            length, width = rng.uniform(11, 15), rng.uniform(12, 15)
        length = min(length, lot - 3.5)
    turned = not row and kind is Kind.GABLE and rng.random() < 0.35
    deep = length if turned else width
    setback = rng.uniform(3.5, 8.0)
    centre = p + normal * (front + setback + deep / 2)
    eaves = rng.uniform(3.0, 6.2) if kind is not Kind.FLAT else rng.uniform(5.5, 8.5)
    if kind is Kind.L_GABLE and rng.random() < 0.5:
        eaves = rng.uniform(2.8, 3.4)
    turn = angle + (np.pi / 2 if turned else 0.0) + rng.normal(0, 0.03)
    house = planner.place(rng, kind, centre, turn, length, width, eaves)
    if house is None:
        return
    ground = planner.ground
    depth = front + setback + deep + rng.uniform(9, 16)
    depth = min(depth, max(front + setback + deep + 5.0, 0.72 * float((middle - p) @ normal)))
    near, far = p + normal * front, p + normal * depth
    half = tangent * lot / 2
    lawn = ground.region(Material.LAWN, angle=angle + rng.choice([0.0, np.pi / 2]), vary=0.14)
    ground.polygon(LAYER_PLOT, [near - half, near + half, far + half, far - half], lawn)
    side = rng.choice([-1.0, 1.0])
    drive = near + tangent * side * (lot / 2 - 2.2)
    surface = Material(rng.choice([Material.PAVING, Material.ASPHALT, Material.GRAVEL,
                                   Material.CONCRETE]))  # fmt: skip
    hard = ground.region(surface, angle=angle, vary=0.09)
    run = setback + rng.uniform(2, 7)
    ground.stroke(LAYER_GARDEN, [drive - normal * 0.5, drive + normal * run], 3.2, hard)
    walk = near - tangent * side * 1.5
    ground.stroke(LAYER_GARDEN, [walk, walk + normal * (setback + 1)], 1.3, hard)
    heading = float(np.arctan2(normal[1], normal[0]))
    if rng.random() < 0.7:
        spot = drive + normal * rng.uniform(2.6, max(2.7, setback))
        planner.slots.append((*spot, heading, 0.8))
    patio = ground.region(Material.PAVING, angle=turn, vary=0.08)
    back = centre + normal * (deep / 2 + 2.0)
    ground.polygon(LAYER_GARDEN, rectangle(back, angle, rng.uniform(4, 8), 4.0), patio)
    if rng.random() < 0.6:
        spot = near + tangent * side * (lot / 2 - 2.2) + normal * (run + 2.8)
        planner.place(rng, Kind.SHED, spot, angle + np.pi / 2, rng.uniform(5.0, 6.5),
                      rng.uniform(3.0, 3.6), rng.uniform(2.3, 2.7), 0.3)  # fmt: skip
    _plan_garden(planner, rng, far, tangent, normal, lot, angle)
    _fence_plot(planner, rng, near, far, half)


def _plan_garden(
    planner: _Planner, rng: np.random.Generator, far: Array, tangent: Array, normal: Array,
    lot: float, angle: float,
) -> None:  # fmt: skip
    ground = planner.ground
    for _ in range(int(rng.integers(2, 6))):
        at = far - normal * rng.uniform(0.5, 9) + tangent * rng.uniform(-0.47, 0.47) * lot
        bed = ground.region(Material.BED, vary=0.1)
        ground.polygon(LAYER_GARDEN, rectangle(at, angle, rng.uniform(2, 6), rng.uniform(0.8, 2)),
                       bed)  # fmt: skip
    at = far - normal * rng.uniform(4, 7) + tangent * rng.uniform(-0.3, 0.3) * lot
    extra = rng.random()
    if extra < 0.10:
        size = rng.uniform(5, 8)
        rim = ground.region(Material.PAVING)
        ground.polygon(LAYER_GARDEN, rectangle(at, angle, size + 2, 5.5), rim)
        pool = ground.region(Material.POOL)
        ground.polygon(LAYER_GARDEN, rectangle(at, angle, size, 3.5), pool)
    elif extra < 0.25:
        rows = ground.region(Material.SOIL, angle=angle, spacing=rng.uniform(0.7, 1.1), vary=0.1)
        ground.polygon(LAYER_GARDEN, rectangle(at, angle, rng.uniform(4, 7), 3.5), rows)
    elif extra < 0.4:
        planner.place(rng, Kind.SHED, at, angle, 3.0, 2.4, 2.1, 0.3)
    for _ in range(int(rng.integers(1, 6))):
        at = far - normal * rng.uniform(0, 11) + tangent * rng.uniform(-0.5, 0.5) * lot
        planner.tree(rng, at, rng.uniform(0.5, 1.1), 2 if rng.random() < 0.4 else None)


def _fence_plot(
    planner: _Planner, rng: np.random.Generator, near: Array, far: Array, half: Array
) -> None:
    inward = (far - near) / max(float(np.linalg.norm(far - near)), 1e-9)
    front = near + inward * 0.8
    gap = half * 0.35
    for a, b, chance in (
        (front - half, far - half, 0.55), (far - half, far + half, 0.45),
        (front - half, front - gap, 0.4), (front + gap * 0.2, front + half * 0.45, 0.3),
    ):  # fmt: skip
        points = a + np.linspace(0, 1, 7)[:, None] * (b - a)
        if rng.random() < chance and planner.taken.free(points, 0.5).all():
            planner.hedges.append(
                Hedge(a, b, rng.uniform(0.6, 1.1), rng.uniform(1.0, 2.1), int(rng.integers(10**9)))
            )


def _scatter_trees(
    planner: _Planner, rng: np.random.Generator, outline: Array, count: int, size: float
) -> None:
    low, high = outline.min(0), outline.max(0)
    contour = outline.astype(np.float32)
    for xy in rng.uniform(low, high, (count, 2)):
        if cv2.pointPolygonTest(contour, (float(xy[0]), float(xy[1])), False) > 0:
            planner.tree(rng, xy, size * rng.uniform(0.7, 1.3))


def _plan_centre(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    for line, street in _frontages(planner, i, j):
        s = int(street.reach_m + 2)
        while s < len(line) - 14:
            length = min(float(rng.uniform(13, 30)), len(line) - street.reach_m - s)
            if length < 9:
                break
            p, tangent, normal = _frame(line, int(s + length / 2))
            width = rng.uniform(10.5, 13.5)
            kind = Kind(rng.choice(["gable", "hip", "flat", "office"], p=[0.42, 0.16, 0.27, 0.15]))
            floors = int(rng.integers(2, 6))
            for setback in (1.2, 2.4, 4.0):
                if planner.place(
                    rng, kind, p + normal * (street.reach_m + setback + width / 2),
                    float(np.arctan2(tangent[1], tangent[0])), length - 0.4, width,
                    floors * 2.9 + 0.6, 0.1,
                ):  # fmt: skip
                    break
            s += int(np.ceil(length + rng.choice([0.0, 0.0, 3.5])))
    middle = outline.mean(0)
    angle = _axis(outline)
    for _ in range(7):  # yards of many owners
        cover = Material(rng.choice([Material.LAWN, Material.ASPHALT, Material.CONCRETE,
                                     Material.GRAVEL, Material.BED, Material.PAVING]))  # fmt: skip
        yard = planner.ground.region(cover, angle=angle, vary=0.14)
        at = middle + rng.uniform(-24, 24, 2)
        planner.ground.polygon(
            LAYER_PLOT, rectangle(at, angle, rng.uniform(9, 26), rng.uniform(8, 22)), yard
        )
    for _ in range(3):
        at = middle + rng.uniform(-14, 14, 2)
        if rng.random() < 0.7:
            planner.place(rng, Kind.FLAT, at, angle + rng.choice([0.0, np.pi / 2]),
                          rng.uniform(12, 24), rng.uniform(8, 12), rng.uniform(3.4, 12),
                          2.5)  # fmt: skip
    _park_rows(planner, rng, middle + rng.uniform(-6, 6, 2), angle, 16.0, 16.0, 0.7)
    for _ in range(8):
        at = middle + rng.uniform(-28, 28, 2)
        planner.place(rng, Kind.SHED, at, angle, rng.uniform(5, 14), rng.uniform(3.5, 7), 3.0, 1.0)
    _scatter_trees(planner, rng, outline, 16, 0.9)


def _plan_blocks(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    angle, middle = _axis(outline), outline.mean(0)
    c, s = np.cos(angle), np.sin(angle)
    along, across = np.array([c, s]), np.array([-s, c])
    first = len(planner.buildings)
    if rng.random() < 0.35:
        for _ in range(3):
            at = middle + along * rng.uniform(-26, 26) + across * rng.uniform(-24, 24)
            planner.place(rng, Kind.TOWER, at, angle + rng.choice([0, np.pi / 2]),
                          rng.uniform(17, 24), rng.uniform(15, 19), rng.uniform(20, 38),
                          6.0)  # fmt: skip
    else:
        for v in (-26.0, 0.0, 26.0):
            at = middle + across * v + along * rng.uniform(-4, 4)
            planner.place(rng, Kind.FLAT, at, angle, rng.uniform(30, 52), rng.uniform(10.5, 13),
                          float(rng.integers(3, 7)) * 2.9, 3.0)  # fmt: skip
    path = planner.ground.region(Material.PAVING, angle=angle)
    for v in (-13.0, 13.0):
        line = [middle + across * v - along * 45, middle + across * v + along * 45]
        planner.ground.stroke(LAYER_PLOT, line, 2.2, path)
    for b in planner.buildings[first:]:
        apron = planner.ground.region(Material.BED if rng.random() < 0.5 else Material.PAVING)
        planner.ground.polygon(LAYER_PLOT, b.corners(1.6), apron)
        walk = planner.ground.region(Material.PAVING, angle=angle)
        start = np.array(b.centre)
        planner.ground.stroke(LAYER_PLOT, [start, start + across * 14.0], 1.8, walk)
    _park_rows(planner, rng, middle + across * 13 + along * 20, angle, 18.0, 17.0, 0.7)
    _park_rows(planner, rng, middle - across * 13 - along * 18, angle, 26.0, 17.0, 0.7)
    play = middle - across * 13 + along * rng.uniform(8, 22)
    sand = planner.ground.region(Material.GRAVEL, vary=0.1)
    planner.ground.polygon(LAYER_GARDEN, rectangle(play, angle + 0.3, 8, 6), sand)
    red = planner.ground.region(Material.TRACK, vary=0.1)
    planner.ground.polygon(LAYER_GARDEN, rectangle(play + along * 9, angle, 6, 9), red)
    for _ in range(9):
        at = middle + along * rng.uniform(-40, 40) + across * rng.uniform(-36, 36)
        bed = planner.ground.region(Material.BED, vary=0.1)
        shrub = rectangle(at, rng.uniform(0, 3), rng.uniform(3, 9), rng.uniform(1.5, 4))
        planner.ground.polygon(LAYER_GARDEN, shrub, bed)
    _scatter_trees(planner, rng, outline, 40, 1.0)


def _plan_industry(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    angle, middle = _axis(outline), outline.mean(0)
    c, s = np.cos(angle), np.sin(angle)
    along, across = np.array([c, s]), np.array([-s, c])
    yard = planner.ground.region(Material.ASPHALT, angle=angle, vary=0.1)
    planner.ground.polygon(
        LAYER_PLOT, rectangle(middle + rng.uniform(-15, 15, 2), angle, 50, 34), yard
    )
    for _ in range(5):
        cover = Material(rng.choice([Material.ASPHALT, Material.CONCRETE, Material.GRAVEL,
                                     Material.MEADOW]))  # fmt: skip
        patch = planner.ground.region(cover, angle=angle, vary=0.14)
        at = middle + along * rng.uniform(-34, 34) + across * rng.uniform(-34, 34)
        shape = rectangle(at, angle, rng.uniform(12, 34), rng.uniform(9, 28))
        planner.ground.polygon(LAYER_PLOT, shape, patch)
    for attempt in range(34):
        at = middle + along * rng.uniform(-36, 36) + across * rng.uniform(-36, 36)
        kind = Kind(rng.choice(["hall", "sawtooth", "office", "silo", "tent"],
                               p=[0.58, 0.1, 0.2, 0.08, 0.04]))  # fmt: skip
        shrink = 1.0 - 0.6 * attempt / 34
        length, width = rng.uniform(30, 62) * shrink, rng.uniform(20, 34) * shrink
        eaves = rng.uniform(5, 11) * (0.5 + 0.5 * shrink)
        if kind is Kind.OFFICE:
            length, width, eaves = rng.uniform(16, 30), rng.uniform(11, 15), rng.uniform(7, 15)
        elif kind is Kind.SILO:
            length = width = rng.uniform(5, 9)
            eaves = rng.uniform(8, 16)
        elif kind is Kind.TENT:
            length, width, eaves = rng.uniform(20, 40), rng.uniform(8, 12), 3.0
        planner.place(rng, kind, at, angle + rng.choice([0, np.pi / 2]), length, width, eaves, 3.5)
    for side in (24.0, -26.0, 8.0):
        _park_rows(planner, rng, middle + along * side + across * rng.uniform(-24, 24), angle, 26.0,
                   17.0, 0.6)  # fmt: skip
    for _ in range(22):  # containers and trailers
        at = middle + along * rng.uniform(-38, 38) + across * rng.uniform(-38, 38)
        for k in range(int(rng.integers(1, 4))):
            planner.place(rng, Kind.CONTAINER, at + across * 2.8 * k, angle, 12.0, 2.44, 2.6, 0.1)
    for line, street in _frontages(planner, i, j):
        strip = offset_line(line, street.reach_m + 1.5)
        grass = planner.ground.region(Material.MEADOW)
        planner.ground.stroke(LAYER_GARDEN, strip[4:-4], 2.6, grass)
    _scatter_trees(planner, rng, outline, 6, 0.8)


def _park_rows(
    planner: _Planner, rng: np.random.Generator, centre: Array, angle: float, length: float,
    width: float, ready: float,
) -> None:  # fmt: skip
    """A car park of double rows, if there is room."""
    polygon = rectangle(centre, angle, length, width)
    if not planner.taken.claim(polygon):
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


def _plan_carpark(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    angle, middle = _axis(outline), outline.mean(0)
    across = np.array([-np.sin(angle), np.cos(angle)])
    kind = Kind.HALL if rng.random() < 0.6 else Kind.DECK
    for length in (46.0, 38.0, 30.0, 22.0):
        if planner.place(rng, kind, middle + across * 19, angle, length, 19.0, 6.5, 2.0):
            break
    for length in (56.0, 46.0, 36.0):
        before = len(planner.slots)
        _park_rows(planner, rng, middle - across * 12, angle, length, 34.0, 0.65)
        if len(planner.slots) > before:
            break
    for line, street in _frontages(planner, i, j):
        for s in range(12, len(line) - 12, 9):
            p, _, normal = _frame(line, s)
            planner.tree(rng, p + normal * (street.reach_m + 2.0), 0.7, 0)


def _plan_church(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    angle, middle = _axis(outline), outline.mean(0)
    planner.place(rng, Kind.CHURCH, middle, angle, rng.uniform(38, 46), rng.uniform(13, 16), 9.0)
    lawn = planner.ground.region(Material.LAWN)
    planner.ground.polygon(LAYER_PLOT, rectangle(middle, angle, 54, 34), lawn)
    path = planner.ground.region(Material.GRAVEL)
    planner.ground.polygon(LAYER_PLOT, rectangle(middle, angle, 48, 22), path)
    for line, street in _frontages(planner, i, j):
        for s in range(14, len(line) - 14, 11):
            p, _, normal = _frame(line, s)
            planner.tree(rng, p + normal * (street.reach_m + 3.5), 0.9, 0)
    _plan_centre(planner, rng, i, j, outline)


def _plan_sports(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    angle, middle = _axis(outline), outline.mean(0)
    c, s = np.cos(angle), np.sin(angle)
    frame = np.array([[c, s], [-s, c]])
    ground = planner.ground
    for scale in (1.25, 1.0, 0.8):
        length, width = 62.0 * scale, 42.0 * scale
        if planner.taken.claim(rectangle(middle, angle, length, width, 3.0)):
            break
    else:
        _plan_park(planner, rng, i, j, outline)
        return
    if rng.random() < 0.5:
        ground.polygon(LAYER_PLOT, rectangle(middle, angle, length, width, 4.0),
                       ground.region(Material.TRACK))  # fmt: skip
    turf = ground.region(Material.TURF, angle=angle)
    ground.polygon(LAYER_GARDEN, rectangle(middle, angle, length, width, 1.5), turf)
    mark = ground.region(Material.MARKING, vary=0.01)
    a, b = length / 2, width / 2

    def draw(points: ArrayLike) -> None:
        ground.stroke(LAYER_GARDEN + 1, np.asarray(points, float) @ frame + middle, 0.25, mark)

    draw([(-a, -b), (a, -b), (a, b), (-a, b), (-a, -b)])
    draw([(0, -b), (0, b)])
    turn = np.linspace(0, 2 * np.pi, 33)
    draw(np.stack([6.5 * np.cos(turn), 6.5 * np.sin(turn)], -1))
    for sign in (-1, 1):
        for depth, span in ((4.0, 6.5), (11.0, 14.0)):
            draw([(sign * a, -span), (sign * (a - depth), -span), (sign * (a - depth), span),
                  (sign * a, span)])  # fmt: skip
    planner.corners.extend(rectangle(middle, angle, length, width))
    for sign in (-1, 1):
        _plan_court(planner, rng, middle + np.array([-s, c]) * sign * (b + 14.0) + np.array([c, s])
                    * sign * a * 0.4, angle)  # fmt: skip
    side = middle + np.array([-s, c]) * (b + 9)
    planner.place(rng, Kind.FLAT, side, angle, 18.0, 6.5, 3.2, 0.5)
    for line, street in _frontages(planner, i, j):
        for k in range(10, len(line) - 10, 12):
            p, _, normal = _frame(line, k)
            planner.tree(rng, p + normal * (street.reach_m + 2.5), 1.0, 0)


def _plan_court(planner: _Planner, rng: np.random.Generator, centre: Array, angle: float) -> None:
    """A tennis court with its run-off."""
    if not planner.taken.claim(rectangle(centre, angle, 30.0, 15.0)):
        return
    ground = planner.ground
    cover = Material.TRACK if rng.random() < 0.7 else Material.ASPHALT
    clay = ground.region(cover, vary=0.1)
    ground.polygon(LAYER_GARDEN, rectangle(centre, angle, 30.0, 15.0), clay)
    mark = ground.region(Material.MARKING)
    for length, width in ((23.8, 11.0), (23.8, 8.2), (12.8, 8.2)):
        corners = rectangle(centre, angle, length, width)
        ground.stroke(LAYER_GARDEN + 1, np.vstack([corners, corners[:1]]), 0.13, mark)


def _plan_park(planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    path = planner.ground.region(Material.GRAVEL)
    middle = outline.mean(0) + rng.uniform(-8, 8, 2)
    for k in (0, 8, 16, 24):
        bend = (outline[k] + middle) / 2 + rng.uniform(-9, 9, 2)
        curve = _curve(outline[k], bend, middle)
        planner.ground.stroke(LAYER_PATH, curve, 2.4, path)
        planner.taken.stroke(curve, 2.8)
    turn = np.linspace(0, 2 * np.pi, 40)
    radius = rng.uniform(7, 11) * (1 + 0.15 * np.sin(2 * turn + 1))
    ring = middle + np.stack([radius * np.cos(turn), radius * np.sin(turn)], -1)
    pond = rng.random() < 0.5
    planner.ground.polygon(LAYER_PATH + 1, middle + 1.2 * (ring - middle), path)
    inner = planner.ground.region(Material.WATER if pond else Material.BED)
    planner.ground.polygon(LAYER_PATH + 1, ring, inner)
    if pond:
        planner.taken.claim(ring)
    for _ in range(8):
        at = outline.mean(0) + rng.uniform(-34, 34, 2)
        bed = planner.ground.region(Material.BED, vary=0.12)
        turn = np.linspace(0, 2 * np.pi, 20)
        size = rng.uniform(1.5, 5, 2)
        planner.ground.polygon(
            LAYER_GARDEN, at + size * np.stack([np.cos(turn), np.sin(turn)], -1), bed
        )
    _scatter_trees(planner, rng, outline, 95, 1.2)


def _curve(a: Array, b: Array, c: Array) -> Array:
    t = np.linspace(0, 1, 14)[:, None]
    return (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t**2 * c


def _plan_field(
    planner: _Planner, rng: np.random.Generator, i: int, j: int,
    fields: dict[tuple[int, int, int], int],
) -> None:  # fmt: skip
    """Strips of crops that run on over neighbouring cells of the same group."""
    lattice = planner.net.lattice
    group = planner.config.rng(30, i // 2 + 500, j // 2 + 500)
    strips = int(group.integers(1, 4))
    for k in range(strips):
        key = (i // 2, j // 2, k)
        if key not in fields:
            u0, v0 = lattice.u[i], lattice.v[j]
            a, b = lattice.warp(np.array([[u0, v0], [u0, v0 + 50.0]]))
            angle = float(np.arctan2(*(b - a)[::-1]))
            kind = Material(group.choice([Material.CROP, Material.SOIL, Material.GRAIN,
                                          Material.MEADOW], p=[0.36, 0.2, 0.32, 0.12]))  # fmt: skip
            fields[key] = planner.ground.region(
                kind, angle=angle, spacing=float(group.uniform(0.9, 1.6)), vary=0.11
            )
        u = np.linspace(lattice.u[i], lattice.u[i + 1], strips + 1)[k : k + 2]
        v = np.linspace(lattice.v[j], lattice.v[j + 1], 9)
        left = np.stack([np.full_like(v, u[0]), v], -1)
        right = np.stack([np.full_like(v, u[1]), v], -1)[::-1]
        polygon = lattice.warp(np.concatenate([left, right]))
        planner.ground.polygon(LAYER_BASE, polygon, fields[key])
        if k:
            track = planner.ground.region(Material.MEADOW if k % 2 else Material.GRAVEL)
            planner.ground.stroke(LAYER_PLOT, lattice.warp(left), rng.uniform(0.8, 2.2), track)


def _hedgerow(planner: _Planner, rng: np.random.Generator, i: int, j: int) -> None:
    """Shrubs and trees along a side of a country cell that has no street."""
    if planner.net.side((i, j), (i + 1, j)) is not None or rng.random() < 0.6:
        return
    line = resample(planner.net.lattice.line((i, j), (i + 1, j)), 3.2)
    strip = planner.ground.region(Material.BED)
    planner.ground.stroke(LAYER_PLOT, line, 3.0, strip)
    for p in line:
        draw = rng.random()
        if draw < 0.75:
            planner.tree(rng, p + rng.normal(0, 0.7, 2), rng.uniform(0.6, 1.5), 2)
        elif draw < 0.87:
            planner.tree(rng, p, 1.0)


def _plan_forest(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    planner.wood(rng, outline, float(rng.uniform(5.6, 6.6)), float(rng.choice([0.15, 0.4, 0.75])))


def _plan_meadow(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    _scatter_trees(planner, rng, outline, int(rng.integers(0, 9)), 1.1)
    a, b = outline[rng.integers(len(outline), size=2)]
    bend = outline.mean(0) + rng.uniform(-15, 15, 2)
    worn = planner.ground.region(Material.GRAVEL, vary=0.1)
    planner.ground.stroke(LAYER_PLOT, _curve(a, bend, b), 0.8, worn)


def _plan_orchard(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    angle, middle = _axis(outline), outline.mean(0)
    c, s = np.cos(angle), np.sin(angle)
    contour = outline.astype(np.float32)
    for u in np.arange(-55, 55, 6.5):
        for v in np.arange(-55, 55, 5.5):
            p = middle + np.array([c * u - s * v, s * u + c * v]) + rng.normal(0, 0.3, 2)
            inside = cv2.pointPolygonTest(contour, (float(p[0]), float(p[1])), True) > 3
            if inside and rng.random() < 0.93:
                planner.tree(rng, p, rng.uniform(1.1, 1.5), 2)


def _plan_farm(planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    angle, middle = _axis(outline) + rng.normal(0, 0.2), outline.mean(0)
    yard = planner.ground.region(Material.CONCRETE, angle=angle, vary=0.1)
    planner.ground.polygon(LAYER_PLOT, rectangle(middle, angle, 42, 34), yard)
    for kind, length, width, eaves in (
        (Kind.BARN, 26.0, 13.0, 5.0), (Kind.GABLE, 14.0, 10.0, 5.5), (Kind.BARN, 18.0, 11.0, 4.5),
        (Kind.SILO, 5.0, 5.0, 11.0), (Kind.SHED, 9.0, 5.0, 2.8), (Kind.TENT, 22.0, 8.0, 2.8),
    ):  # fmt: skip
        for _ in range(4):
            at = middle + rng.uniform(-24, 24, 2)
            turn = angle + rng.choice([0.0, np.pi / 2])
            k = rng.uniform(0.85, 1.2)
            if planner.place(rng, kind, at, turn, length * k, width, eaves, 3.0):
                break
    frontage = _frontages(planner, i, j)
    if frontage:
        line, _ = frontage[0]
        lane = planner.ground.region(Material.GRAVEL)
        planner.ground.stroke(LAYER_PLOT, [line[len(line) // 2], middle], 3.4, lane)
    for k in range(3):
        spot = middle + rng.uniform(-14, 14, 2)
        planner.slots.append((*spot, angle + k, 0.5))
    _scatter_trees(planner, rng, outline, 14, 1.1)


def _plan_riverside(
    planner: _Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    _scatter_trees(planner, rng, outline, 40, 1.2)
    _scatter_trees(planner, rng, outline, 16, 0.8)
    for _ in range(30):
        p = outline.mean(0) + rng.uniform(-50, 50, 2)
        planner.tree(rng, p, rng.uniform(0.7, 1.6), 2)


def _park_along_streets(
    planner: _Planner, rng: np.random.Generator, zones: dict[tuple[int, int], Zone]
) -> None:
    for street in planner.net.streets:
        if street.rank != 1:
            continue
        line = cut_ends(street.points, 13.0, 13.0)
        if line is None:
            continue
        side = rng.choice([-1.0, 1.0])
        kerb = offset_line(line, side * (street.width_m / 2 - 1.05))
        for k in range(3, len(kerb) - 3, 7):
            _, tangent, _ = _frame(kerb, k)
            planner.slots.append((*kerb[k], float(np.arctan2(tangent[1], tangent[0])), 0.45))


def _plant_street_trees(planner: _Planner, rng: np.random.Generator) -> None:
    for street in planner.net.streets:
        chance = (0.65, 0.2, 0.5)[street.rank]
        if rng.random() > chance:
            continue
        line = cut_ends(street.points, 12.0, 12.0)
        if line is None:
            continue
        step = int(rng.integers(9, 16))
        out = street.width_m / 2 + (1.5 if street.rank == 0 else 2.2)
        for side in (-1, 1):
            row = offset_line(line, side * out)
            for k in range(0, len(row), step):
                radius = rng.uniform(1.7, 2.8)
                self_seed = int(rng.integers(1 << 30))
                if np.abs(row[k]).max() < planner.config.half_m - 5:
                    planner.trees.append(
                        (*row[k], radius, radius * rng.uniform(2.3, 2.9), 0, 0, self_seed)
                    )


_CELLS = {
    Zone.CENTRE: _plan_centre,
    Zone.HOUSES: _plan_houses,
    Zone.BLOCKS: _plan_blocks,
    Zone.INDUSTRY: _plan_industry,
    Zone.PARK: _plan_park,
    Zone.SPORTS: _plan_sports,
    Zone.CARPARK: _plan_carpark,
    Zone.CHURCH: _plan_church,
    Zone.FOREST: _plan_forest,
    Zone.MEADOW: _plan_meadow,
    Zone.ORCHARD: _plan_orchard,
    Zone.FARM: _plan_farm,
    Zone.RIVERSIDE: _plan_riverside,
}
