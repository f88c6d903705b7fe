"""Urban cells besides houses: centre, blocks, industry, sports, parks; and the streets' edges.

Functions as in `country`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from localizer.geometry.pose import Array
from localizer.synth.buildings.shell import Kind, rectangle
from localizer.synth.paint.ground_plan import Material
from localizer.synth.plan.planner import (
    LAYER_GARDEN,
    LAYER_PATH,
    LAYER_PLOT,
    Planner,
    bezier,
    frontages,
    line_frame,
    main_axis,
    park_rows,
    scatter_trees,
)
from localizer.synth.plan.streets import cut_ends, offset_line


def plan_centre(planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    """Closed rows of tall houses along the streets, and yards behind them."""
    for line, street in frontages(planner, i, j):
        s = int(street.reach_m + 2)
        while s < len(line) - 14:
            length = min(float(rng.uniform(13, 30)), len(line) - street.reach_m - s)
            if length < 9:
                break
            p, tangent, normal = line_frame(line, int(s + length / 2))
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
    angle = main_axis(outline)
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
    park_rows(planner, rng, middle + rng.uniform(-6, 6, 2), angle, 16.0, 16.0, 0.7)
    for _ in range(8):
        at = middle + rng.uniform(-28, 28, 2)
        planner.place(rng, Kind.SHED, at, angle, rng.uniform(5, 14), rng.uniform(3.5, 7), 3.0, 1.0)
    scatter_trees(planner, rng, outline, 16, 0.9)


def plan_blocks(planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    """Slabs of flats on lawns, with car parks."""
    angle, middle = main_axis(outline), outline.mean(0)
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
    park_rows(planner, rng, middle + across * 13 + along * 20, angle, 18.0, 17.0, 0.7)
    park_rows(planner, rng, middle - across * 13 - along * 18, angle, 26.0, 17.0, 0.7)
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
    scatter_trees(planner, rng, outline, 40, 1.0)


def plan_industry(
    planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    """Halls, yards and car parks."""
    angle, middle = main_axis(outline), outline.mean(0)
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
        park_rows(planner, rng, middle + along * side + across * rng.uniform(-24, 24), angle, 26.0,
                   17.0, 0.6)  # fmt: skip
    for _ in range(22):  # containers and trailers
        at = middle + along * rng.uniform(-38, 38) + across * rng.uniform(-38, 38)
        for k in range(int(rng.integers(1, 4))):
            planner.place(rng, Kind.CONTAINER, at + across * 2.8 * k, angle, 12.0, 2.44, 2.6, 0.1)
    for line, street in frontages(planner, i, j):
        strip = offset_line(line, street.reach_m + 1.5)
        grass = planner.ground.region(Material.MEADOW)
        planner.ground.stroke(LAYER_GARDEN, strip[4:-4], 2.6, grass)
    scatter_trees(planner, rng, outline, 6, 0.8)


def plan_carpark(
    planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    """A large car park."""
    angle, middle = main_axis(outline), outline.mean(0)
    across = np.array([-np.sin(angle), np.cos(angle)])
    kind = Kind.HALL if rng.random() < 0.6 else Kind.DECK
    for length in (46.0, 38.0, 30.0, 22.0):
        if planner.place(rng, kind, middle + across * 19, angle, length, 19.0, 6.5, 2.0):
            break
    for length in (56.0, 46.0, 36.0):
        before = len(planner.slots)
        park_rows(planner, rng, middle - across * 12, angle, length, 34.0, 0.65)
        if len(planner.slots) > before:
            break
    for line, street in frontages(planner, i, j):
        for s in range(12, len(line) - 12, 9):
            p, _, normal = line_frame(line, s)
            planner.plant_tree(rng, p + normal * (street.reach_m + 2.0), 0.7, 0)


def plan_church(planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    """A church on its square, among houses of the centre."""
    angle, middle = main_axis(outline), outline.mean(0)
    planner.place(rng, Kind.CHURCH, middle, angle, rng.uniform(38, 46), rng.uniform(13, 16), 9.0)
    lawn = planner.ground.region(Material.LAWN)
    planner.ground.polygon(LAYER_PLOT, rectangle(middle, angle, 54, 34), lawn)
    path = planner.ground.region(Material.GRAVEL)
    planner.ground.polygon(LAYER_PLOT, rectangle(middle, angle, 48, 22), path)
    for line, street in frontages(planner, i, j):
        for s in range(14, len(line) - 14, 11):
            p, _, normal = line_frame(line, s)
            planner.plant_tree(rng, p + normal * (street.reach_m + 3.5), 0.9, 0)
    plan_centre(planner, rng, i, j, outline)


def plan_sports(planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    """A sports ground with pitches and courts, or a park where it does not fit."""
    angle, middle = main_axis(outline), outline.mean(0)
    c, s = np.cos(angle), np.sin(angle)
    frame = np.array([[c, s], [-s, c]])
    ground = planner.ground
    for scale in (1.25, 1.0, 0.8):
        length, width = 62.0 * scale, 42.0 * scale
        if planner.taken.occupy(rectangle(middle, angle, length, width, 3.0)):
            break
    else:
        plan_park(planner, rng, i, j, outline)
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
    for line, street in frontages(planner, i, j):
        for k in range(10, len(line) - 10, 12):
            p, _, normal = line_frame(line, k)
            planner.plant_tree(rng, p + normal * (street.reach_m + 2.5), 1.0, 0)


def _plan_court(planner: Planner, rng: np.random.Generator, centre: Array, angle: float) -> None:
    """A tennis court with its run-off."""
    if not planner.taken.occupy(rectangle(centre, angle, 30.0, 15.0)):
        return
    ground = planner.ground
    cover = Material.TRACK if rng.random() < 0.7 else Material.ASPHALT
    clay = ground.region(cover, vary=0.1)
    ground.polygon(LAYER_GARDEN, rectangle(centre, angle, 30.0, 15.0), clay)
    mark = ground.region(Material.MARKING)
    for length, width in ((23.8, 11.0), (23.8, 8.2), (12.8, 8.2)):
        corners = rectangle(centre, angle, length, width)
        ground.stroke(LAYER_GARDEN + 1, np.vstack([corners, corners[:1]]), 0.13, mark)


def plan_park(planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    """Lawn, paths and groups of trees."""
    path = planner.ground.region(Material.GRAVEL)
    middle = outline.mean(0) + rng.uniform(-8, 8, 2)
    for k in (0, 8, 16, 24):
        bend = (outline[k] + middle) / 2 + rng.uniform(-9, 9, 2)
        curve = bezier(outline[k], bend, middle)
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
        planner.taken.occupy(ring)
    for _ in range(8):
        at = outline.mean(0) + rng.uniform(-34, 34, 2)
        bed = planner.ground.region(Material.BED, vary=0.12)
        turn = np.linspace(0, 2 * np.pi, 20)
        size = rng.uniform(1.5, 5, 2)
        planner.ground.polygon(
            LAYER_GARDEN, at + size * np.stack([np.cos(turn), np.sin(turn)], -1), bed
        )
    scatter_trees(planner, rng, outline, 95, 1.2)


def park_along_streets(planner: Planner, rng: np.random.Generator) -> None:
    """Add parking slots along one kerb of each side street (rank 1)."""
    for street in planner.net.streets:
        if street.rank != 1:
            continue
        line = cut_ends(street.points, 13.0, 13.0)
        if line is None:
            continue
        side = rng.choice([-1.0, 1.0])
        kerb = offset_line(line, side * (street.width_m / 2 - 1.05))
        for k in range(3, len(kerb) - 3, 7):
            _, tangent, _ = line_frame(kerb, k)
            planner.slots.append((*kerb[k], float(np.arctan2(tangent[1], tangent[0])), 0.45))


def plant_street_trees(planner: Planner, rng: np.random.Generator) -> None:
    """Plant rows of trees along streets."""
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
