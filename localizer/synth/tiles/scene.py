"""One visit to a planned world: what stands there, and the surface model that throws shadows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.synth.buildings.kinds import build
from localizer.synth.buildings.shell import LEAF, MID, Building
from localizer.synth.config import TERRAIN_SPACING_M
from localizer.synth.paint.lighting import DSM_GSD_M, raise_surface
from localizer.synth.plan.planner import Hedge, WorldPlan
from localizer.synth.plan.terrain import Terrain
from localizer.synth.tiles.vegetation import PropShape, car_shape, hedge_corners, tree_meshes
from localizer.synth.visits.visit import Visit, apply_changes

_DSM_MARGIN_M = 20.0


@dataclass(frozen=True)
class TileScene:
    """One visit to a planned world: what stands there, and the surface model that throws shadows.

    plan: with the visit's changes. cars: (C, 4) x, y, heading, seed; dsm, ground: (H, W) float32
    heights, row 0 = north.
    """

    plan: WorldPlan
    visit: Visit
    buildings: list[Building]
    cars: Array
    dsm: NDArray[np.float32]
    ground: NDArray[np.float32]
    west: float
    north: float


def make_scene(plan: WorldPlan, visit: Visit) -> TileScene:
    """Apply the visit's changes, fill parking slots, remove buildings, and model the surface."""
    look = visit.look
    if visit.changes is not None:
        plan = apply_changes(plan, visit.changes)
    rng = plan.config.rng(40, look.parking_seed)
    buildings = plan.buildings
    if look.changed_buildings > 0:
        gone = rng.random(len(buildings)) < look.changed_buildings
        buildings = [b for b, g in zip(buildings, gone, strict=True) if not g]
    taken = rng.random(len(plan.slots)) < plan.slots[:, 3] * (look.occupancy / 0.6)
    cars = plan.slots[taken].copy()
    if len(cars):
        cars[:, :2] += rng.normal(0, 0.12, (len(cars), 2))
        cars[:, 2] += rng.normal(0, 0.025, len(cars)) + np.pi * rng.integers(0, 2, len(cars))
        cars[:, 3] = rng.integers(0, 1 << 20, len(cars))

    half = plan.config.half_m + _DSM_MARGIN_M
    n = round(2 * half / DSM_GSD_M)
    axis = (np.arange(n) + 0.5) * DSM_GSD_M - half
    index = ((axis + plan.terrain.half_m) / TERRAIN_SPACING_M).astype(np.float32)
    u, v = np.meshgrid(index, index[::-1])
    heights = plan.terrain.heights
    ground = cv2.remap(heights, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    ground = np.asarray(ground, np.float32)
    dsm = ground.copy()
    triangles = [_fan(s.polygon) for b in buildings for s in build(b) if s.levels & MID]
    triangles += [_fan(q) for h in plan.hedges for q in hedge_quads(plan.terrain, h)]
    if triangles:
        raise_surface(dsm, np.concatenate(triangles), -half, half, DSM_GSD_M)
    trees = plan.trees
    if len(trees.xy):
        every = np.arange(len(trees.xy))
        z = plan.terrain.height(trees.xy[:, 0], trees.xy[:, 1])
        crowns = tree_meshes(trees, every, z, np.zeros(len(every), bool), [], (LEAF,))
        raise_surface(dsm, crowns.positions[crowns.faces], -half, half, DSM_GSD_M)
    if len(cars):
        shape = car_shape()
        body = car_positions(plan.terrain, cars, shape)[:, shape.faces].reshape(-1, 3, 3)
        raise_surface(dsm, body, -half, half, DSM_GSD_M)
    return TileScene(plan, visit, buildings, cars, dsm, ground, -half, half)


def _fan(polygon: Array) -> Array:
    n = len(polygon)
    return np.stack([polygon[[0, k, k + 1]] for k in range(1, n - 1)])


def hedge_quads(terrain: Terrain, hedge: Hedge) -> list[Array]:
    """The sides and the top of a hedge, (4, 3) each."""
    za, zb = (float(terrain.height(p[0], p[1])) for p in (hedge.a, hedge.b))
    return hedge_corners(hedge, za, zb)


def car_positions(terrain: Terrain, cars: Array, shape: PropShape) -> Array:
    """(C, V, 3) vertices of cars that stand on the slope below them."""
    c, s = np.cos(cars[:, 2]), np.sin(cars[:, 2])

    def height(forward: float, left: float) -> Array:
        return terrain.height(
            cars[:, 0] + c * forward - s * left, cars[:, 1] + s * forward + c * left
        )

    pitch = (height(1.3, 0) - height(-1.3, 0)) / 2.6
    roll = (height(0, 0.8) - height(0, -0.8)) / 1.6
    x, y, z = shape.positions.T
    out = np.empty((len(cars), len(x), 3))
    out[..., 0] = cars[:, :1] + np.outer(c, x) - np.outer(s, y)
    out[..., 1] = cars[:, 1:2] + np.outer(s, x) + np.outer(c, y)
    out[..., 2] = height(0, 0)[:, None] + z + np.outer(pitch, x) + np.outer(roll, y)
    return out
