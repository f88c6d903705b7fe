"""The plan of a world: what stands where. Made once per seed; every visit paints the same plan."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from localizer.geometry.pose import Array
from localizer.synth.buildings.kinds import build
from localizer.synth.buildings.shell import Building, Kind, Surface, rectangle
from localizer.synth.config import WorldConfig
from localizer.synth.paint.ground_plan import GroundPlan, Material
from localizer.synth.plan.country import (
    hedgerow,
    plan_farm,
    plan_field,
    plan_forest,
    plan_houses,
    plan_meadow,
    plan_orchard,
    plan_riverside,
)
from localizer.synth.plan.planner import (
    CROSS,
    LAYER_BASE,
    LAYER_WATER,
    URBAN,
    Occupancy,
    PlannedTarget,
    Planner,
    Trees,
    WorldPlan,
    Zone,
    main_axis,
)
from localizer.synth.plan.streets import (
    LAYER_KERB,
    Lattice,
    StreetNet,
    make_lattice,
    make_streets,
    offset_line,
    paint_streets,
    resample,
)
from localizer.synth.plan.terrain import Terrain, make_terrain
from localizer.synth.plan.town import (
    park_along_streets,
    plan_blocks,
    plan_carpark,
    plan_centre,
    plan_church,
    plan_industry,
    plan_park,
    plan_sports,
    plant_street_trees,
)

_USES: dict[str, tuple[tuple[Zone, float], ...]] = {
    "forest": ((Zone.FOREST, 0.85), (Zone.MEADOW, 0.15)),
    "fields": ((Zone.FIELD, 0.8), (Zone.MEADOW, 0.1), (Zone.FARM, 0.1)),
    "industrial": ((Zone.INDUSTRY, 0.8), (Zone.CARPARK, 0.1), (Zone.BLOCKS, 0.1)),
    "dense": ((Zone.CENTRE, 0.8), (Zone.BLOCKS, 0.2)),
}
_SITES = 0.06  # of the buildings
_SITE_TRIES = 40  # most ground is taken


def assign_zones(config: WorldConfig, lattice: Lattice, terrain: Terrain
           ) -> dict[tuple[int, int], Zone]:  # fmt: skip
    """Use of every cell that overlaps the world."""
    rng = config.rng(12)
    small = config.size_m < 1000
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
    if config.character != "mixed":
        return _of_one_character(config, zones)
    if radius > 150:
        _give_landmarks(zones, distance)
    return zones


def _of_one_character(
    config: WorldConfig, zones: dict[tuple[int, int], Zone]
) -> dict[tuple[int, int], Zone]:
    """The zones with all cells but those at the river set to the world's character."""
    rng = config.rng(65)
    uses, shares = zip(*_USES[config.character], strict=True)
    draws = rng.choice(len(uses), len(zones), p=shares)
    return {
        cell: zone if zone is Zone.RIVERSIDE else uses[draw]
        for (cell, zone), draw in zip(zones.items(), draws, strict=True)
    }


def _give_landmarks(
    zones: dict[tuple[int, int], Zone], distance: dict[tuple[int, int], float]
) -> None:
    """Add a church, a car park, a sports ground and a park near the centre of the town."""
    order = sorted((c for c in zones if zones[c] is not Zone.RIVERSIDE), key=distance.__getitem__)
    for rank, zone in ((1, Zone.CHURCH), (2, Zone.CARPARK), (5, Zone.SPORTS), (7, Zone.PARK),
                       (9, Zone.BLOCKS), (14, Zone.SPORTS)):  # fmt: skip
        if rank < len(order) and zones[order[rank]] in URBAN:
            zones[order[rank]] = zone


def _raise_bridges(terrain: Terrain, net: StreetNet) -> Terrain:
    """The terrain with causeways where streets cross the river."""
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
    """Plan all static objects of the world of this seed and size."""
    terrain = make_terrain(config)
    lattice = make_lattice(config)
    zones = assign_zones(config, lattice, terrain)
    net = make_streets(config, terrain, {c: z in URBAN for c, z in zones.items()}, lattice)
    terrain = _raise_bridges(terrain, net)
    planner = Planner(config, terrain, net, GroundPlan(config.rng(13)), Occupancy(config))
    planner.ground.region(Material.MEADOW)  # region 0: what nothing else covers
    for street in net.streets:
        planner.taken.stroke(street.points, 2 * street.reach_m + 0.6)
    _paint_water(planner)
    paint_streets(net, planner.ground)
    fields: dict[tuple[int, int, int], int] = {}
    for (i, j), zone in zones.items():
        _plan_cell(planner, config.rng(20, i + 500, j + 500), i, j, zone, zones, fields)
    park_along_streets(planner, config.rng(14))
    plant_street_trees(planner, config.rng(15))
    return _finish(planner)


def _finish(planner: Planner) -> WorldPlan:
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
        trees, hedges, slots, _targets(planner), _roads(planner), _sites(planner),
    )  # fmt: skip


def _sites(planner: Planner) -> tuple[Building, ...]:
    """Free plots near houses with a building that may be built later; none is in the plan."""
    rng = planner.config.rng(60)
    standing = list(planner.buildings)
    if not standing:
        return ()
    for _ in range(_SITE_TRIES * max(1, round(_SITES * len(standing)))):
        beside = standing[int(rng.integers(len(standing)))]
        turn, reach = rng.uniform(0, 2 * np.pi), rng.uniform(14, 45)
        at = np.array(beside.centre) + reach * np.array([np.cos(turn), np.sin(turn)])
        kind = Kind(rng.choice(["gable", "hip", "flat", "barn"]))
        length, width = rng.uniform(9, 18), rng.uniform(8, 12)
        planner.place(rng, kind, at, beside.angle, length, width, rng.uniform(3, 8), 2.5)
        if len(planner.buildings) >= (1 + _SITES) * len(standing):
            break
    sites = tuple(planner.buildings[len(standing) :])
    del planner.buildings[len(standing) :]
    return sites


def _roads(planner: Planner) -> tuple[Array, ...]:
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


def _targets(planner: Planner) -> tuple[PlannedTarget, ...]:
    """Static points near the centre: a crossing, a flat roof, a pitch's corner (or a node)."""
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
    return tuple(PlannedTarget(name, p) for name, p in points)


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
            z = [_height_over(surfaces, corner + 1.2 * step) for step in CROSS]
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


def _paint_water(planner: Planner) -> None:
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


def _plan_cell(
    planner: Planner, rng: np.random.Generator, i: int, j: int, zone: Zone,
    zones: dict[tuple[int, int], Zone], fields: dict[tuple[int, int, int], int],
) -> None:  # fmt: skip
    outline = planner.net.lattice.cell(i, j)
    base = {
        Zone.CENTRE: Material.PAVING, Zone.HOUSES: Material.LAWN, Zone.BLOCKS: Material.LAWN,
        Zone.INDUSTRY: Material.CONCRETE, Zone.PARK: Material.LAWN, Zone.SPORTS: Material.LAWN,
        Zone.CARPARK: Material.LAWN, Zone.CHURCH: Material.PAVING, Zone.FOREST: Material.FOREST,
    }.get(zone, Material.MEADOW)  # fmt: skip
    angle = main_axis(outline)
    if zone is not Zone.FIELD:
        region = planner.ground.region(base, angle=angle)
        planner.ground.polygon(LAYER_BASE, outline, region)
    if zone is Zone.FIELD:
        plan_field(planner, rng, i, j, fields)
    else:
        _CELLS[zone](planner, rng, i, j, outline)
    if zone in (Zone.MEADOW, Zone.FIELD, Zone.ORCHARD):
        hedgerow(planner, rng, i, j)


_CELLS = {
    Zone.CENTRE: plan_centre,
    Zone.HOUSES: plan_houses,
    Zone.BLOCKS: plan_blocks,
    Zone.INDUSTRY: plan_industry,
    Zone.PARK: plan_park,
    Zone.SPORTS: plan_sports,
    Zone.CARPARK: plan_carpark,
    Zone.CHURCH: plan_church,
    Zone.FOREST: plan_forest,
    Zone.MEADOW: plan_meadow,
    Zone.ORCHARD: plan_orchard,
    Zone.FARM: plan_farm,
    Zone.RIVERSIDE: plan_riverside,
}
