"""One visit to a planned world: what stands there, painted, and the surface that casts shadows."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.synth.buildings.kinds import build
from localizer.synth.buildings.shell import LEAF, MID, NEAR_LEVELS, Building, Surface
from localizer.synth.config import LEAF_GSD_M, LEAF_M, TERRAIN_SPACING_M
from localizer.synth.paint.covers import Cover, WindowLight, new_image
from localizer.synth.paint.facades import paint_surface
from localizer.synth.paint.lighting import DSM_GSD_M, raise_surface
from localizer.synth.plan.planner import Hedge, WorldPlan
from localizer.synth.plan.terrain import Terrain
from localizer.synth.tiles.charts import ChartedMesh
from localizer.synth.tiles.vegetation import (
    CAR_COLOURS,
    PropShape,
    car_image,
    car_shape,
    crown_images,
    hedge_corners,
    tree_meshes,
)
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


_MAX_CHART_PX = 800
_CAR_PX_PER_M = 16


class StandingObjects:
    """The objects of a scene by leaf tile; an object belongs to the tile of its middle."""

    def __init__(self, scene: TileScene) -> None:
        self._scene = scene
        self._leaf_buildings: dict[tuple[int, int], list[Building]] = defaultdict(list)
        for building in scene.buildings:
            self._leaf_buildings[self._leaf_of(np.array(building.centre))].append(building)

    def _leaf_of(self, xy: Array) -> tuple[int, int]:
        column, row = np.floor((xy + self._scene.plan.config.half_m) / LEAF_M).astype(int)
        return int(column), int(row)

    def leaf_mesh(self, leaf: tuple[int, int], light: WindowLight) -> ChartedMesh:
        """The mesh of a leaf tile, (column, row) from south-west, with its painted charts."""
        parts = [
            self._surface(s, light) for b in self._leaf_buildings.get(leaf, ()) for s in build(b)
        ]
        west, south = np.array(leaf) * LEAF_M - self._scene.plan.config.half_m
        parts += self._hedges(west, south, light)
        parts.append(self._trees(leaf, west, south, light))
        parts.append(self._cars(west, south, light))
        return ChartedMesh.merged([p for p in parts if len(p.faces)])

    def _surface(self, surface: Surface, light: WindowLight) -> ChartedMesh:
        width, length = surface.extent
        gsd = max(LEAF_GSD_M, max(width, length) / _MAX_CHART_PX)
        out = new_image(max(2, int(np.ceil(length / gsd))), max(2, int(np.ceil(width / gsd))))
        paint_surface(
            surface.cover, surface.origin, surface.right, surface.down, surface.normal, gsd,
            width, length, surface.base, surface.accent, surface.params, surface.floor_z,
            surface.eaves_z, surface.seed, light.ceiling, light.ambient, light.west, light.north,
            light.gsd_m, light.sun, light.sun_rgb, light.sky_rgb, light.season, out,
        )  # fmt: skip
        survey = self._scene.visit.survey
        if survey is not None:
            out = survey.apply_blur(out, gsd, float(surface.normal[2]))
        n = len(surface.polygon)
        away = surface.polygon - surface.origin
        st = np.stack([away @ surface.right, away @ surface.down], -1) / gsd
        faces = np.array([(0, k, k + 1) for k in range(1, n - 1)], np.int64)
        return ChartedMesh(
            surface.polygon, np.zeros(n, np.int64), st, faces,
            np.full(len(faces), surface.levels, np.uint8), (out,),
        )  # fmt: skip

    def _hedges(self, west: float, south: float, light: WindowLight) -> list[ChartedMesh]:
        parts = []
        for hedge in self._scene.plan.hedges:
            if not _in_leaf((hedge.a + hedge.b) / 2, west, south):
                continue
            rng = np.random.default_rng(hedge.seed)
            colour = np.array([84.0, 98.0, 56.0]) * rng.normal(1, 0.12)
            for quad in hedge_quads(self._scene.plan.terrain, hedge):
                normal = np.cross(quad[1] - quad[0], quad[3] - quad[0])
                normal /= max(float(np.linalg.norm(normal)), 1e-9)
                right = quad[1] - quad[0]
                right /= max(float(np.linalg.norm(right)), 1e-9)
                down = np.cross(right, normal)
                u, v = (quad - quad[0]) @ right, (quad - quad[0]) @ down
                surface = Surface(
                    quad, quad[0] + right * u.min() + down * v.min(), right, down, normal,
                    (float(np.ptp(u)), float(np.ptp(v))), int(Cover.HEDGE), colour, np.zeros(3),
                    np.zeros(6), float(quad[:, 2].min()), 0.0, hedge.seed, NEAR_LEVELS,
                )  # fmt: skip
                parts.append(self._surface(surface, light))
        return parts

    def _trees(
        self, leaf: tuple[int, int], west: float, south: float, light: WindowLight
    ) -> ChartedMesh:
        trees = self._scene.plan.trees
        xy = trees.xy
        chosen = np.flatnonzero(_in_leaf(xy, west, south))
        if not len(chosen):
            return ChartedMesh.empty()
        z = self._scene.plan.terrain.height(xy[chosen, 0], xy[chosen, 1])
        column = ((xy[chosen, 0] - light.west) / light.gsd_m).astype(int)
        row = ((light.north - xy[chosen, 1]) / light.gsd_m).astype(int)
        top = z + 0.75 * trees.height[chosen]
        shaded = light.ceiling[row, column] > top
        changes = self._scene.visit.changes
        leaves = () if changes is None else (changes.seed,)  # other leaves, another texture
        rng = self._scene.plan.config.rng(50, leaf[0] + 500, leaf[1] + 500, *leaves)
        look = self._scene.visit.look
        return tree_meshes(trees, chosen, z, shaded, crown_images(rng, look, light))

    def _cars(self, west: float, south: float, light: WindowLight) -> ChartedMesh:
        cars = self._scene.cars
        cars = cars[_in_leaf(cars[:, :2], west, south)]
        if not len(cars):
            return ChartedMesh.empty()
        shape = car_shape()
        row = ((light.north - cars[:, 1]) / light.gsd_m).astype(int)
        column = ((cars[:, 0] - light.west) / light.gsd_m).astype(int)
        z = self._scene.plan.terrain.height(cars[:, 0], cars[:, 1])
        shaded = light.ceiling[row, column] > z + 1.6
        colours = cars[:, 3].astype(int) % len(CAR_COLOURS)
        used, chart = np.unique(colours * 2 + shaded, return_inverse=True)
        images = []
        for key in used:
            image = car_image(CAR_COLOURS[key // 2], int(key), self._scene.visit.look)
            shade = 0.45 if key % 2 else 1.0
            image = np.asarray(image * shade, np.uint8)
            size = (image.shape[1] * 5 // 8, image.shape[0] * 5 // 8)
            images.append(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)))
        n, m = len(cars), len(shape.positions)
        st = np.broadcast_to(shape.st * _CAR_PX_PER_M * 5 / 8, (n, m, 2)).reshape(-1, 2)
        faces = (shape.faces[None] + (np.arange(n) * m)[:, None, None]).reshape(-1, 3)
        return ChartedMesh(
            car_positions(self._scene.plan.terrain, cars, shape).reshape(-1, 3),
            np.repeat(chart.reshape(-1), m).astype(np.int64), st.copy(), faces.astype(np.int64),
            np.full(len(faces), NEAR_LEVELS, np.uint8), tuple(images),
        )  # fmt: skip


def _in_leaf(xy: Array, west: float, south: float) -> NDArray[np.bool_]:
    """Mask (...) of the points (..., 2) in the leaf tile whose corner is (west, south)."""
    low = np.array([west, south])
    return np.asarray(((xy >= low) & (xy < low + LEAF_M)).all(-1))
