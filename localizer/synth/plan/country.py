"""Cells outside the centre: houses, fields, woods, meadows, orchards, farms, the riverside.

Each ``plan_`` function fills one cell (i, j) of the street lattice and adds to `planner`.
outline: of `Lattice.cell`, (N, 2) ENU metres, counter-clockwise.
"""

from __future__ import annotations

import cv2
import numpy as np

from localizer.geometry.pose import Array
from localizer.synth.buildings.shell import Kind, rectangle
from localizer.synth.paint.ground_plan import Material
from localizer.synth.plan.planner import (
    LAYER_BASE,
    LAYER_GARDEN,
    LAYER_PLOT,
    Hedge,
    Planner,
    axis_rows,
    bezier,
    frontages,
    line_frame,
    main_axis,
    pair_grid,
    scatter_trees,
)
from localizer.synth.plan.streets import Street, resample


def plan_houses(planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    """Detached houses on plots along the streets, and what lies behind them."""
    rows = rng.random() < 0.22
    for line, street in frontages(planner, i, j):
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
    scatter_trees(planner, rng, outline, int(rng.integers(14, 34)), 0.75)


def _plan_interior(planner: Planner, rng: np.random.Generator, outline: Array) -> None:
    """The middle of a residential block: allotments, a second row of houses, or an orchard."""
    use = rng.random()
    if use < 0.45:
        _plan_allotments(planner, rng, outline)
    elif use < 0.8:
        _plan_second_row(planner, rng, outline)
    else:
        for local in pair_grid(np.arange(-14, 15, 6.0), np.arange(-12, 13, 5.5)):
            planner.plant_tree(
                rng, outline.mean(0) + local @ axis_rows(outline), rng.uniform(0.9, 1.5), 2
            )


def _plan_allotments(planner: Planner, rng: np.random.Generator, outline: Array) -> None:
    angle, middle, frame = main_axis(outline), outline.mean(0), axis_rows(outline)
    ground = planner.ground
    lane = ground.region(Material.GRAVEL, vary=0.1)
    ground.polygon(LAYER_GARDEN, rectangle(middle, angle, 37, 27), lane)
    for local in pair_grid(np.arange(-15, 16, 7.5), (-9.6, -3.6, 3.6, 9.6)):
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
            planner.plant_tree(rng, at, 1.0, 2)


def _plan_second_row(planner: Planner, rng: np.random.Generator, outline: Array) -> None:
    angle, middle, frame = main_axis(outline), outline.mean(0), axis_rows(outline)
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
    ground.stroke(LAYER_GARDEN, bezier(outline[4], middle, end), 3.0, lane)


def _plan_plot(  # noqa: PLR0913
    planner: Planner, rng: np.random.Generator, line: Array, s: int, lot: float, street: Street,
    row: bool, middle: Array,
) -> None:  # fmt: skip
    p, tangent, normal = line_frame(line, s)
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
    planner: Planner, rng: np.random.Generator, far: Array, tangent: Array, normal: Array,
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
        planner.plant_tree(rng, at, rng.uniform(0.5, 1.1), 2 if rng.random() < 0.4 else None)


def _fence_plot(
    planner: Planner, rng: np.random.Generator, near: Array, far: Array, half: Array
) -> None:
    inward = (far - near) / max(float(np.linalg.norm(far - near)), 1e-9)
    front = near + inward * 0.8
    gap = half * 0.35
    for a, b, chance in (
        (front - half, far - half, 0.55), (far - half, far + half, 0.45),
        (front - half, front - gap, 0.4), (front + gap * 0.2, front + half * 0.45, 0.3),
    ):  # fmt: skip
        points = a + np.linspace(0, 1, 7)[:, None] * (b - a)
        if rng.random() < chance and planner.taken.is_free(points, 0.5).all():
            planner.hedges.append(
                Hedge(a, b, rng.uniform(0.6, 1.1), rng.uniform(1.0, 2.1), int(rng.integers(10**9)))
            )


def plan_field(
    planner: Planner, rng: np.random.Generator, i: int, j: int,
    fields: dict[tuple[int, int, int], int],
) -> None:  # fmt: skip
    """Fill the cell (column i, row j) with strips of crops that continue in neighbouring cells.
    fields: the regions drawn so far by (i // 2, j // 2, strip), updated.
    """
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


def hedgerow(planner: Planner, rng: np.random.Generator, i: int, j: int) -> None:
    """Plant shrubs and trees along the side of a cell from node (i, j) to (i + 1, j), if no street
    runs there; not on every such side.
    """
    if planner.net.side((i, j), (i + 1, j)) is not None or rng.random() < 0.6:
        return
    line = resample(planner.net.lattice.line((i, j), (i + 1, j)), 3.2)
    strip = planner.ground.region(Material.BED)
    planner.ground.stroke(LAYER_PLOT, line, 3.0, strip)
    for p in line:
        draw = rng.random()
        if draw < 0.75:
            planner.plant_tree(rng, p + rng.normal(0, 0.7, 2), rng.uniform(0.6, 1.5), 2)
        elif draw < 0.87:
            planner.plant_tree(rng, p, 1.0)


def plan_forest(planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    """Fill the cell with a wood."""
    planner.plant_wood(
        rng, outline, float(rng.uniform(5.6, 6.6)), float(rng.choice([0.15, 0.4, 0.75]))
    )


def plan_meadow(planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    """Grass with some trees and a trodden path."""
    scatter_trees(planner, rng, outline, int(rng.integers(0, 9)), 1.1)
    a, b = outline[rng.integers(len(outline), size=2)]
    bend = outline.mean(0) + rng.uniform(-15, 15, 2)
    worn = planner.ground.region(Material.GRAVEL, vary=0.1)
    planner.ground.stroke(LAYER_PLOT, bezier(a, bend, b), 0.8, worn)


def plan_orchard(
    planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    """Fruit trees in rows, up to 55 m from the middle along each axis."""
    angle, middle = main_axis(outline), outline.mean(0)
    c, s = np.cos(angle), np.sin(angle)
    contour = outline.astype(np.float32)
    for u in np.arange(-55, 55, 6.5):
        for v in np.arange(-55, 55, 5.5):
            p = middle + np.array([c * u - s * v, s * u + c * v]) + rng.normal(0, 0.3, 2)
            inside = cv2.pointPolygonTest(contour, (float(p[0]), float(p[1])), True) > 3
            if inside and rng.random() < 0.93:
                planner.plant_tree(rng, p, rng.uniform(1.1, 1.5), 2)


def plan_farm(planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array) -> None:
    """Place a farmyard with its buildings in the cell (column i, row j), and a lane to a street if
    the cell has one. outline: (N, 2) of the cell, ENU metres.
    """
    angle, middle = main_axis(outline) + rng.normal(0, 0.2), outline.mean(0)
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
    frontage = frontages(planner, i, j)
    if frontage:
        line, _ = frontage[0]
        lane = planner.ground.region(Material.GRAVEL)
        planner.ground.stroke(LAYER_PLOT, [line[len(line) // 2], middle], 3.4, lane)
    for k in range(3):
        spot = middle + rng.uniform(-14, 14, 2)
        planner.slots.append((*spot, angle + k, 0.5))
    scatter_trees(planner, rng, outline, 14, 1.1)


def plan_riverside(
    planner: Planner, rng: np.random.Generator, i: int, j: int, outline: Array
) -> None:
    """Bushes and trees along the water."""
    scatter_trees(planner, rng, outline, 40, 1.2)
    scatter_trees(planner, rng, outline, 16, 0.8)
    for _ in range(30):
        p = outline.mean(0) + rng.uniform(-50, 50, 2)
        planner.plant_tree(rng, p, rng.uniform(0.7, 1.6), 2)
