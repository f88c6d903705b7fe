"""Painting and writing tiles: a block of 200 m at a time, then the coarse tiles above them."""

from __future__ import annotations

import pickle
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.pose import Array
from localizer.synth.buildings import (
    LEAF,
    MID,
    NEAR_LEVELS,
    ROOT,
    TOP,
    Building,
    Surface,
    build,
)
from localizer.synth.config import BLOCK_M, LEAF_GSD_M, LEAF_M, TERRAIN_SPACING_M, TOP_M, Look
from localizer.synth.ground import Shape, rasterize, shape_bounds
from localizer.synth.lighting import DSM_GSD_M, make_light, raise_surface
from localizer.synth.mesh import ChartedMesh, pack
from localizer.synth.plan import Hedge, WorldPlan
from localizer.synth.props import CAR_COLOURS, PropShape, car_image, car_shape
from localizer.synth.terrain import Terrain
from localizer.synth.textures import Cover, Light, new_image, paint_ground, paint_surface
from localizer.synth.tiles import TileNode, glb_bytes
from localizer.synth.vegetation import crown_images, hedge_corners, tree_meshes
from localizer.types import Image

_DSM_MARGIN_M = 20.0
_LIGHT_MARGIN_M = 60.0  # objects belong to the tile of their middle and reach out of it
_GUTTER_PX, _PAD_PX = 16, 4
_MAX_CHART_PX = 800
_CAR_PX_PER_M = 16
_GRID = {LEAF: 1, MID: 2, TOP: 4, ROOT: 8}  # terrain cells merged per side
_NAMES = {LEAF: "leaf", MID: "mid", TOP: "top", ROOT: "root"}
_SIDE_M = {LEAF: LEAF_M, MID: BLOCK_M, TOP: TOP_M}


@dataclass(frozen=True)
class Scene:
    """One visit to a planned world: what stands there, and the surface model that throws shadows.

    cars: (C, 4) x, y, heading, seed; dsm, ground: (H, W) float32 heights, row 0 = north.
    """

    plan: WorldPlan
    look: Look
    buildings: list[Building]
    cars: Array
    dsm: NDArray[np.float32]
    ground: NDArray[np.float32]
    west: float
    north: float


@dataclass(frozen=True)
class Part:
    """What a finished tile hands up to the next coarser one. ground: its image at twice the texel
    size of that tile's; mesh: what coarser levels still show; node: itself.
    """

    nodes: list[TileNode]
    ground: Image
    mesh: ChartedMesh
    west: float
    north: float


def make_scene(plan: WorldPlan, look: Look) -> Scene:
    """Fill parking places, take away changed buildings, and model the surface."""
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
    triangles += [_fan(q) for h in plan.hedges for q in _hedge_quads(plan.terrain, h)]
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
        body = _car_positions(plan.terrain, cars, shape)[:, shape.faces].reshape(-1, 3, 3)
        raise_surface(dsm, body, -half, half, DSM_GSD_M)
    return Scene(plan, look, buildings, cars, dsm, ground, -half, half)


def _fan(polygon: Array) -> Array:
    n = len(polygon)
    return np.stack([polygon[[0, k, k + 1]] for k in range(1, n - 1)])


def _hedge_quads(terrain: Terrain, hedge: Hedge) -> list[Array]:
    za, zb = (float(terrain.height(p[0], p[1])) for p in (hedge.a, hedge.b))
    return hedge_corners(hedge, za, zb)


def _car_positions(terrain: Terrain, cars: Array, shape: PropShape) -> Array:
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


@dataclass
class Baker:
    """Paints the tiles of one scene into a folder. Belongs to one process."""

    scene: Scene
    folder: Path
    _bounds: Array = field(init=False)
    _leaf_buildings: dict[tuple[int, int], list[Building]] = field(init=False)
    _slopes: tuple[NDArray[np.float32], NDArray[np.float32]] = field(init=False)

    def __post_init__(self) -> None:
        self._bounds = shape_bounds(self.scene.plan.shapes)
        self._slopes = self.scene.plan.terrain.gradient()
        self._leaf_buildings = defaultdict(list)
        for building in self.scene.buildings:
            self._leaf_buildings[self._leaf_of(np.array(building.centre))].append(building)

    def _leaf_of(self, xy: Array) -> tuple[int, int]:
        column, row = np.floor((xy + self.scene.plan.config.half_m) / LEAF_M).astype(int)
        return int(column), int(row)

    def block(self, column: int, row: int) -> Part:
        """Paint and write the four leaves and the middle tile of a block; count from south-west."""
        half = self.scene.plan.config.half_m
        west, south = column * BLOCK_M - half, row * BLOCK_M - half
        north = south + BLOCK_M
        light = self._light(west, north)
        ground = self._ground(west, north, light)
        n = ground.shape[0] // 2
        leaves, meshes = [], []
        for dy in (0, 1):
            for dx in (0, 1):
                leaf = (2 * column + dx, 2 * row + dy)
                mesh = self._objects(leaf, light)
                image = ground[(1 - dy) * n : (2 - dy) * n, dx * n : (dx + 1) * n]
                leaf_west, leaf_north = west + dx * LEAF_M, south + (dy + 1) * LEAF_M
                leaves.append(self.write(LEAF, leaf, leaf_west, leaf_north, image, mesh))
                meshes.append(mesh)
        image = _half(ground)
        mesh = ChartedMesh.merged(meshes)
        mesh = mesh.at_level(MID | TOP | ROOT).halved()
        middle = self.write(MID, (column, row), west, north, image, mesh)
        middle.children = leaves
        return Part([middle], _half(image), mesh.at_level(TOP | ROOT).halved(), west, north)

    def write(
        self, level: int, place: tuple[int, int], west: float, north: float, ground: Image,
        mesh: ChartedMesh,
    ) -> TileNode:  # fmt: skip
        """Write one tile: terrain with its image, and the mesh's faces of this level."""
        terrain = self.scene.plan.terrain
        side = self.scene.plan.config.size_m if level == ROOT else _SIDE_M[level]
        shown = mesh.at_level(level)
        scale = {LEAF: 0, MID: 1, TOP: 2, ROOT: 4}[level]
        atlas = pack(ground, shown.charts, _GUTTER_PX, max(1, _PAD_PX >> scale))
        size = np.array([atlas.image.shape[1], atlas.image.shape[0]], float)
        points, st, faces, error = terrain_mesh(terrain, west, north, side, _GRID[level])
        uv = (st * ground.shape[0] + atlas.ground) / size
        uv_shown = (shown.st + atlas.offsets[shown.chart]) / size if len(shown.st) else shown.st
        positions = np.concatenate([points, shown.positions])
        origin = np.array([west + side / 2, north - side / 2, float(points[:, 2].mean())])
        origin = np.round(origin, 3)
        local = (positions - origin).astype(np.float32)
        data = glb_bytes(
            local, np.concatenate([uv, uv_shown]).astype(np.float32),
            np.concatenate([faces, shown.faces + len(points)]), atlas.image,
        )  # fmt: skip
        uri = f"{_NAMES[level]}_{place[0]}_{place[1]}.glb"
        (self.folder / uri).write_bytes(data)
        low, high = local.min(0).astype(float), local.max(0).astype(float)
        dropped = self._dropped_m(level, west, north, side)
        return TileNode(uri, origin, origin + low, origin + high, max(error, dropped))

    def _dropped_m(self, level: int, west: float, north: float, side: float) -> float:
        """Size of what a level leaves out or simplifies within a tile, metres."""
        if level == LEAF:
            return 0.0
        xy = self.scene.plan.trees.xy
        inside = (xy[:, 0] >= west) & (xy[:, 0] < west + side)
        inside &= (xy[:, 1] <= north) & (xy[:, 1] > north - side)
        radius = self.scene.plan.trees.radius[inside].max(initial=0.0)
        if level == MID:
            return float(0.3 * radius) + 0.35  # rounder crowns, inner sides of parapets
        if level == TOP:
            return float(max(3.0, 0.8 * radius))  # cars, hedges, chimneys, dormers
        return float(self.scene.plan.trees.height[inside].max(initial=3.0))

    def _light(self, west: float, north: float) -> Light:
        scene = self.scene
        margin = _LIGHT_MARGIN_M
        left = max(0, int((west - margin - scene.west) / DSM_GSD_M))
        top = max(0, int((scene.north - north - margin) / DSM_GSD_M))
        n = scene.dsm.shape[0]
        right = min(n, int((west + BLOCK_M + margin - scene.west) / DSM_GSD_M))
        bottom = min(n, int((scene.north - north + BLOCK_M + margin) / DSM_GSD_M))
        window = (top, left, bottom - top, right - left)
        return make_light(scene.dsm, scene.ground, scene.west, scene.north, window, scene.look)

    def _ground(self, west: float, north: float, light: Light) -> Image:
        plan = self.scene.plan
        n = round(BLOCK_M / LEAF_GSD_M)
        b = self._bounds
        near = (b[:, 0] < west + BLOCK_M) & (b[:, 2] > west)
        near &= (b[:, 1] < north) & (b[:, 3] > north - BLOCK_M)
        shapes: list[Shape] = [plan.shapes[k] for k in np.flatnonzero(near)]
        region = rasterize(shapes, west, north, LEAF_GSD_M, (n, n))
        out = new_image(n, n)
        paint_ground(
            region, plan.regions.material, plan.regions.tint, plan.regions.shape,
            west, north, LEAF_GSD_M, plan.terrain.heights, *self._slopes,
            plan.terrain.spacing_m, plan.terrain.half_m, light.ceiling, light.ambient, light.west,
            light.north, light.gsd_m, light.sun, light.sun_rgb, light.sky_rgb, light.season, out,
        )  # fmt: skip
        return out

    def _objects(self, leaf: tuple[int, int], light: Light) -> ChartedMesh:
        """Everything that stands on a leaf tile."""
        parts = [
            self._surface(s, light) for b in self._leaf_buildings.get(leaf, ()) for s in build(b)
        ]
        west, south = np.array(leaf) * LEAF_M - self.scene.plan.config.half_m
        parts += self._hedges(west, south, light)
        parts.append(self._trees(leaf, west, south, light))
        parts.append(self._cars(west, south, light))
        return ChartedMesh.merged([p for p in parts if len(p.faces)])

    def _surface(self, surface: Surface, light: Light) -> ChartedMesh:
        width, length = surface.extent
        gsd = max(LEAF_GSD_M, max(width, length) / _MAX_CHART_PX)
        out = new_image(max(2, int(np.ceil(length / gsd))), max(2, int(np.ceil(width / gsd))))
        paint_surface(
            surface.cover, surface.origin, surface.right, surface.down, surface.normal, gsd,
            width, length, surface.base, surface.accent, surface.params, surface.floor_z,
            surface.eaves_z, surface.seed, light.ceiling, light.ambient, light.west, light.north,
            light.gsd_m, light.sun, light.sun_rgb, light.sky_rgb, light.season, out,
        )  # fmt: skip
        n = len(surface.polygon)
        away = surface.polygon - surface.origin
        st = np.stack([away @ surface.right, away @ surface.down], -1) / gsd
        faces = np.array([(0, k, k + 1) for k in range(1, n - 1)], np.int64)
        return ChartedMesh(
            surface.polygon, np.zeros(n, np.int64), st, faces,
            np.full(len(faces), surface.levels, np.uint8), (out,),
        )  # fmt: skip

    def _hedges(self, west: float, south: float, light: Light) -> list[ChartedMesh]:
        parts = []
        for hedge in self.scene.plan.hedges:
            middle = (hedge.a + hedge.b) / 2
            if not (west <= middle[0] < west + LEAF_M and south <= middle[1] < south + LEAF_M):
                continue
            rng = np.random.default_rng(hedge.seed)
            colour = np.array([84.0, 98.0, 56.0]) * rng.normal(1, 0.12)
            for quad in _hedge_quads(self.scene.plan.terrain, hedge):
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

    def _trees(self, leaf: tuple[int, int], west: float, south: float, light: Light) -> ChartedMesh:
        trees = self.scene.plan.trees
        xy = trees.xy
        inside = (xy[:, 0] >= west) & (xy[:, 0] < west + LEAF_M)
        inside &= (xy[:, 1] >= south) & (xy[:, 1] < south + LEAF_M)
        chosen = np.flatnonzero(inside)
        if not len(chosen):
            return ChartedMesh.empty()
        z = self.scene.plan.terrain.height(xy[chosen, 0], xy[chosen, 1])
        column = ((xy[chosen, 0] - light.west) / light.gsd_m).astype(int)
        row = ((light.north - xy[chosen, 1]) / light.gsd_m).astype(int)
        top = z + 0.75 * trees.height[chosen]
        shaded = light.ceiling[row, column] > top
        rng = self.scene.plan.config.rng(50, leaf[0] + 500, leaf[1] + 500)
        return tree_meshes(trees, chosen, z, shaded, crown_images(rng, self.scene.look, light))

    def _cars(self, west: float, south: float, light: Light) -> ChartedMesh:
        cars = self.scene.cars
        inside = (cars[:, 0] >= west) & (cars[:, 0] < west + LEAF_M)
        inside &= (cars[:, 1] >= south) & (cars[:, 1] < south + LEAF_M)
        cars = cars[inside]
        if not len(cars):
            return ChartedMesh.empty()
        shape = car_shape()
        row = ((light.north - cars[:, 1]) / light.gsd_m).astype(int)
        column = ((cars[:, 0] - light.west) / light.gsd_m).astype(int)
        z = self.scene.plan.terrain.height(cars[:, 0], cars[:, 1])
        shaded = light.ceiling[row, column] > z + 1.6
        colours = cars[:, 3].astype(int) % len(CAR_COLOURS)
        used, chart = np.unique(colours * 2 + shaded, return_inverse=True)
        images = []
        for key in used:
            image = car_image(CAR_COLOURS[key // 2], int(key), self.scene.look)
            shade = 0.45 if key % 2 else 1.0
            image = np.asarray(image * shade, np.uint8)
            size = (image.shape[1] * 5 // 8, image.shape[0] * 5 // 8)
            images.append(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)))
        n, m = len(cars), len(shape.positions)
        st = np.broadcast_to(shape.st * _CAR_PX_PER_M * 5 / 8, (n, m, 2)).reshape(-1, 2)
        faces = (shape.faces[None] + (np.arange(n) * m)[:, None, None]).reshape(-1, 3)
        return ChartedMesh(
            _car_positions(self.scene.plan.terrain, cars, shape).reshape(-1, 3),
            np.repeat(chart.reshape(-1), m).astype(np.int64), st.copy(), faces.astype(np.int64),
            np.full(len(faces), NEAR_LEVELS, np.uint8), tuple(images),
        )  # fmt: skip


def _half(image: Image) -> Image:
    size = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def terrain_mesh(
    terrain: Terrain, west: float, north: float, side: float, step: int
) -> tuple[Array, Array, NDArray[np.int64], float]:
    """Terrain of a square tile from every `step`-th grid node, with a skirt.

    Returns positions (V, 3), place in the tile (V, 2) as a share of its side (right, down), faces
    (F, 3), and the largest vertical deviation from the full grid in metres.
    """
    spacing, half = terrain.spacing_m, terrain.half_m
    c0, r0 = round((west + half) / spacing), round((north - side + half) / spacing)
    cells = round(side / spacing)
    fine = terrain.heights[r0 : r0 + cells + 1, c0 : c0 + cells + 1].astype(np.float64)
    grid = fine[::step, ::step]
    coarse = Terrain(grid.astype(np.float32), spacing * step, terrain.river)
    axis = np.linspace(-side / 2, side / 2, cells + 1)
    fx, fy = np.meshgrid(axis, axis)
    error = float(np.abs(coarse.height(fx, fy) - fine).max())

    n = grid.shape[0]
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    top = np.stack([west + x * side, north - side + y * side, grid], -1).reshape(-1, 3)
    share = np.stack([x, 1 - y], -1).reshape(-1, 2)
    index = np.arange(n * n).reshape(n, n)
    sw, se, nw, ne = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    lower, upper = np.stack([sw, se, ne], -1), np.stack([sw, ne, nw], -1)
    faces = [lower.reshape(-1, 3), upper.reshape(-1, 3)]

    # Neighbours of another level may lie lower by both their errors.
    depth = 1.0 + 0.05 * spacing * step + 2 * error
    ring = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    skirt = top[ring] - [0, 0, depth]
    a, b = ring, np.roll(ring, -1)
    low_a = n * n + np.arange(len(ring))
    low_b = np.roll(low_a, -1)
    faces += [np.stack([a, low_a, low_b], -1), np.stack([a, low_b, b], -1)]
    return (
        np.concatenate([top, skirt]),
        np.concatenate([share, share[ring]]),
        np.concatenate(faces).astype(np.int64),
        error,
    )


def assemble_top(baker: Baker, column: int, row: int, parts: list[Part]) -> Part:
    """Write the 400 m tile over four blocks."""
    half = baker.scene.plan.config.half_m
    west, north = column * TOP_M - half, (row + 1) * TOP_M - half
    n = parts[0].ground.shape[0]
    image = new_image(2 * n, 2 * n)
    for part in parts:
        i, j = round((north - part.north) / BLOCK_M) * n, round((part.west - west) / BLOCK_M) * n
        image[i : i + n, j : j + n] = part.ground
    mesh = ChartedMesh.merged([p.mesh for p in parts])
    node = baker.write(TOP, (column, row), west, north, image, mesh)
    node.children = [child for p in parts for child in p.nodes]
    return Part([node], _half(_half(image)), mesh.at_level(ROOT).halved(2), west, north)


def assemble_root(baker: Baker, parts: list[Part]) -> TileNode:
    """Write the tile over the whole world, with trees painted on its ground."""
    half = baker.scene.plan.config.half_m
    n = parts[0].ground.shape[0]
    side = round(2 * half / TOP_M) * n
    image = new_image(side, side)
    for part in parts:
        i, j = round((half - part.north) / TOP_M) * n, round((part.west + half) / TOP_M) * n
        image[i : i + n, j : j + n] = part.ground
    gsd = 2 * half / side
    trees = baker.scene.plan.trees
    for (x, y), radius, seed in zip(trees.xy, trees.radius, trees.seed, strict=True):
        tone = 0.8 + 0.4 * ((int(seed) * 7919) % 101) / 101
        centre = (round((x + half) / gsd * 16 - 8), round((half - y) / gsd * 16 - 8))
        colour = (74 * tone, 88 * tone, 50 * tone)
        cv2.circle(image, centre, round(radius / gsd * 16), colour, -1, cv2.LINE_AA, 4)
    mesh = ChartedMesh.merged([p.mesh for p in parts])
    node = baker.write(ROOT, (0, 0), -half, half, image, mesh)
    node.children = [child for p in parts for child in p.nodes]
    return node


_baker: list[Baker] = []  # the baker of a worker process, set once by `start_worker`


def start_worker(scene_file: Path, folder: Path) -> None:
    """Initialise a worker process."""
    cv2.setNumThreads(1)
    with scene_file.open("rb") as file:
        _baker[:] = [Baker(pickle.load(file), folder)]


def bake_block(place: tuple[int, int]) -> tuple[tuple[int, int], Part]:
    """Paint one block in a worker process."""
    return place, _baker[0].block(*place)
