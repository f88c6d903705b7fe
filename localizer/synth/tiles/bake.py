"""Painting and writing tiles, a block of 200 m at a time."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.synth.buildings.shell import LEAF, MID, NEAR_LEVELS, ROOT, TOP
from localizer.synth.config import BLOCK_M, LEAF_GSD_M, LEAF_M, TOP_M
from localizer.synth.paint.covers import WindowLight, new_image
from localizer.synth.paint.ground import light_ground, paint_albedo
from localizer.synth.paint.ground_plan import Material, PlanShape, rasterize, shape_bounds
from localizer.synth.paint.lighting import DSM_GSD_M, make_light
from localizer.synth.plan.terrain import Terrain
from localizer.synth.tiles.charts import ChartedMesh, pack
from localizer.synth.tiles.scene import StandingObjects, TileScene
from localizer.synth.tiles.write import TileNode, glb_bytes
from localizer.synth.visits.visit import noise, with_new_texture, with_wet_patches
from localizer.types import Float32, Image

_LIGHT_MARGIN_M = 60.0  # objects belong to the tile of their middle and reach out of it
_GUTTER_PX, _PAD_PX = 16, 4
_PATCH_M = 2.0  # resolution of wet and dry patches
_GRID = {LEAF: 1, MID: 2, TOP: 4, ROOT: 8}  # terrain cells merged per side
_NAMES = {LEAF: "leaf", MID: "mid", TOP: "top", ROOT: "root"}
_SIDE_M = {LEAF: LEAF_M, MID: BLOCK_M, TOP: TOP_M}
_SOFT = (
    Material.MEADOW, Material.LAWN, Material.TURF, Material.CROP, Material.SOIL, Material.GRAIN,
    Material.FOREST, Material.WATER, Material.BED, Material.BANK,
)  # fmt: skip
_IS_SOFT = np.isin(np.arange(len(Material)), _SOFT)  # by material: its fine texture does not last


@dataclass(frozen=True)
class TilePart:
    """What a finished tile gives to the next coarser one. ground: its ground image at twice the
    texel size; mesh: the objects that coarser levels still show; nodes: the tile's own.
    """

    nodes: list[TileNode]
    ground: Image
    mesh: ChartedMesh
    west: float
    north: float


@dataclass
class Baker:
    """Paints the tiles of one scene into a folder. Belongs to one process. west, north: edges, ENU
    m.
    """

    scene: TileScene
    folder: Path
    _bounds: Array = field(init=False)
    _standing: StandingObjects = field(init=False)
    _slopes: tuple[NDArray[np.float32], NDArray[np.float32]] = field(init=False)

    def __post_init__(self) -> None:
        self._bounds = shape_bounds(self.scene.plan.shapes)
        self._slopes = self.scene.plan.terrain.gradient()
        self._standing = StandingObjects(self.scene)

    def block(self, column: int, row: int) -> TilePart:
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
                mesh = self._standing.leaf_mesh(leaf, light)
                image = ground[(1 - dy) * n : (2 - dy) * n, dx * n : (dx + 1) * n]
                leaf_west, leaf_north = west + dx * LEAF_M, south + (dy + 1) * LEAF_M
                leaves.append(self.write(LEAF, leaf, leaf_west, leaf_north, image, mesh))
                meshes.append(mesh)
        image = half_size(ground)
        mesh = ChartedMesh.merged(meshes)
        mesh = mesh.at_level(MID | TOP | ROOT).halved()
        middle = self.write(MID, (column, row), west, north, image, mesh)
        middle.children = leaves
        return TilePart([middle], half_size(image), mesh.at_level(TOP | ROOT).halved(), west, north)

    def write(
        self, level: int, place: tuple[int, int], west: float, north: float, ground: Image,
        mesh: ChartedMesh,
    ) -> TileNode:  # fmt: skip
        """Write one tile: terrain with its image, and the mesh's faces of this level. place:
        (column, row), for the file's name; west, north: its top-left corner.
        """
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
        faces = np.concatenate([faces, shown.faces + len(points)])
        survey = self.scene.visit.survey
        if survey is not None:
            if level & NEAR_LEVELS:
                world_m = self.scene.plan.config.size_m
                faces = faces[survey.outside_holes(positions, faces, world_m)]
            positions = survey.displaced(positions)
        origin = np.array([west + side / 2, north - side / 2, float(points[:, 2].mean())])
        origin = np.round(origin, 3)
        local = (positions - origin).astype(np.float32)
        data = glb_bytes(
            local, np.concatenate([uv, uv_shown]).astype(np.float32), faces, atlas.image
        )
        uri = f"{_NAMES[level]}_{place[0]}_{place[1]}.glb"
        (self.folder / uri).write_bytes(data)
        low, high = local.min(0).astype(float), local.max(0).astype(float)
        dropped = self._dropped_m(level, west, north, side)
        return TileNode(uri, origin, origin + low, origin + high, max(error, dropped))

    def _dropped_m(self, level: int, west: float, north: float, side: float) -> float:
        """Size (m) of the details that a level omits or simplifies within a tile."""
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

    def _light(self, west: float, north: float) -> WindowLight:
        scene = self.scene
        margin = _LIGHT_MARGIN_M
        left = max(0, int((west - margin - scene.west) / DSM_GSD_M))
        top = max(0, int((scene.north - north - margin) / DSM_GSD_M))
        n = scene.dsm.shape[0]
        right = min(n, int((west + BLOCK_M + margin - scene.west) / DSM_GSD_M))
        bottom = min(n, int((scene.north - north + BLOCK_M + margin) / DSM_GSD_M))
        window = (top, left, bottom - top, right - left)
        look = scene.visit.look
        return make_light(scene.dsm, scene.ground, scene.west, scene.north, window, look)

    def _ground(self, west: float, north: float, light: WindowLight) -> Image:
        plan = self.scene.plan
        n = round(BLOCK_M / LEAF_GSD_M)
        b = self._bounds
        near = (b[:, 0] < west + BLOCK_M) & (b[:, 2] > west)
        near &= (b[:, 1] < north) & (b[:, 3] > north - BLOCK_M)
        shapes: list[PlanShape] = [plan.shapes[k] for k in np.flatnonzero(near)]
        region = rasterize(shapes, west, north, LEAF_GSD_M, (n, n))
        albedo = self._albedo(region, west, north, light)
        out = new_image(n, n)
        light_ground(
            albedo, west, north, LEAF_GSD_M, plan.terrain.heights, *self._slopes,
            plan.terrain.spacing_m, plan.terrain.half_m, light.ceiling, light.ambient, light.west,
            light.north, light.gsd_m, light.sun, light.sun_rgb, light.sky_rgb, out,
        )  # fmt: skip
        survey = self.scene.visit.survey
        return out if survey is None else survey.apply_blur(out, LEAF_GSD_M)

    def _albedo(self, region: NDArray[np.uint16], west: float, north: float, light: WindowLight
                ) -> Float32:  # fmt: skip
        """Colours (n, n, 3) of a block's ground, 0 to 255, with the visit's new fine texture."""
        albedo = self._painted(region, west, north, light, np.zeros(2))
        changes = self.scene.visit.changes
        if changes is None:
            return albedo
        plan = self.scene.plan
        # The same draw in every block, so that what is drawn does not change at its border.
        rng = plan.config.rng(63, changes.seed)
        anew = self._painted(region, west, north, light, rng.uniform(2000, 9000, 2))
        lasting = np.where(_IS_SOFT[plan.regions.material], np.float32(0), np.float32(1))[region]
        scale = np.float32(255)
        albedo = with_new_texture(albedo / scale, lasting, LEAF_GSD_M, rng, anew / scale)
        wet = with_wet_patches(albedo, lasting, rng, self._patches(west, north, len(region)))
        return np.asarray(wet * scale, np.float32)

    def _painted(
        self,
        region: NDArray[np.uint16],
        west: float,
        north: float,
        light: WindowLight,
        moved: Array,
    ) -> Float32:
        out = np.empty((*region.shape, 3), np.float32)
        regions = self.scene.plan.regions
        paint_albedo(
            region, regions.material, regions.tint, regions.shape, west, north, LEAF_GSD_M,
            light.season, moved, out,
        )  # fmt: skip
        return out

    def _patches(self, west: float, north: float, side: int) -> Float32:
        """The part (side, side) of the world's noise over a block: patches have no seams."""
        config, changes = self.scene.plan.config, self.scene.visit.changes
        rng = config.rng(64, 0 if changes is None else changes.seed)
        field = noise(round(config.size_m / _PATCH_M), rng, round(config.size_m / 25.0), 3, 0.6)
        axis = (np.arange(side, dtype=np.float32) + 0.5) * LEAF_GSD_M
        u = (west + config.half_m + axis) / _PATCH_M - 0.5
        v = (config.half_m - north + axis) / _PATCH_M - 0.5
        grid = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
        return np.asarray(
            cv2.remap(field, *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )


def half_size(image: Image) -> Image:
    """The image at half its width and height."""
    size = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


_baker: list[Baker] = []  # the baker of a worker process, set once by `start_worker`


def start_worker(scene_file: Path, folder: Path) -> None:
    """Initialise a worker process for `bake_block` with the scene pickled in `scene_file`."""
    cv2.setNumThreads(1)
    with scene_file.open("rb") as file:
        _baker[:] = [Baker(pickle.load(file), folder)]


def bake_block(place: tuple[int, int]) -> tuple[tuple[int, int], TilePart]:
    """`Baker.block` in a worker process; returns its place, too."""
    return place, _baker[0].block(*place)


def assemble_top(baker: Baker, column: int, row: int, parts: list[TilePart]) -> TilePart:
    """Write the 400 m tile (column, row from south-west) over its four blocks `parts`; returns its
    part for the tile above.
    """
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
    return TilePart([node], half_size(half_size(image)), mesh.at_level(ROOT).halved(2), west, north)


def assemble_root(baker: Baker, parts: list[TilePart]) -> TileNode:
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
