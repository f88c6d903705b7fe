"""Cells outside the town: fields, woods, meadows, orchards, farms, the riverside.

Each ``plan_`` function fills one cell (i, j) of the street lattice and adds to `planner`.
outline: of `Lattice.cell`, (N, 2) ENU metres, counter-clockwise.
"""

from __future__ import annotations

import cv2
import numpy as np

from localizer.geometry.pose import Array
from localizer.synth.buildings.model import Kind, rectangle
from localizer.synth.paint.ground_plan import Material
from localizer.synth.plan.planner import (
    LAYER_BASE,
    LAYER_PLOT,
    Planner,
    bezier,
    frontages,
    main_axis,
    scatter_trees,
)
from localizer.synth.plan.streets import resample


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
