"""Quadtree of a mesh: leaves are cut out of it, coarser levels are rendered from above."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.building.staging import texel_size
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.map.importers.heightmesh import ERROR_PER_STEP, height_mesh
from localizer.map.importers.rules import ImportRules
from localizer.map.source import SourceMesh, SourceNode
from localizer.render.base import StaticTiles
from localizer.render.numba_raster import NumbaRenderer
from localizer.types import Float32, Image

TEXELS = 512  # of a tile's side
CELLS = 128  # of a tile's side
# Cells by which a surface goes on beyond its border: one that the border crosses, and one that
# simplification may take away there. Else cracks are seen between neighbours.
_GROWN = 2
_EYE_M = 50_000.0  # height of the camera: rays all but parallel
_DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # camera axes: x east, y south

Textured = tuple[SourceMesh, tuple[Image, ...]]  # a mesh and its mips


def tile_error_m(size: float) -> float:
    """Geometric error (m) of a tile of `size` metres made by `render_height_field`."""
    return ERROR_PER_STEP * size / CELLS


def render_height_field(
    groups: Iterable[Sequence[Textured]], left: float, top: float, size: float
) -> list[SourceMesh]:
    """Render the meshes of a square (metres, z up) from above as one textured height field; empty
    without a surface there. groups: rendered one after the other to save memory. left, top: western
    and northern edge; size: side.
    """
    step = size / CELLS
    heights = np.full((CELLS + 1, CELLS + 1), -np.inf)
    image = np.zeros((TEXELS, TEXELS, 3), np.uint8)
    surface = np.full((TEXELS, TEXELS), -np.inf)
    for group in groups:
        if not group:
            continue
        # About the square's centre, and a height that keeps float32 small.
        base = float(group[0][0].positions[0, 2])
        centre = np.array([left + size / 2, top - size / 2, base])
        tiles = [t for mesh, mips in group if (t := _placed(mesh, mips, centre, size)) is not None]
        if not tiles:
            continue
        _, depth = _drawn(tiles, CELLS + 1, step)
        heights = np.maximum(heights, _height(depth, base))
        rgb, depth = _drawn(tiles, TEXELS, size / TEXELS)
        z = _height(depth, base)
        higher = z > surface
        image[higher], surface[higher] = rgb[higher], z[higher]
    if not np.isfinite(heights).any():
        return []
    for _ in range(_GROWN):
        heights = _grown(heights)
    image, shown = _grown_picture(image, np.isfinite(surface))
    known = np.isfinite(heights)
    lowest = heights[known].min()
    z = np.ma.masked_array(np.where(known, heights - lowest, 0.0), ~known)
    made = height_mesh(z, shown, (step, step), lossless=False)
    if made is None:
        return []
    local, faces = made
    uvs = (local[:, :2] * (1, -1) / size).astype(np.float32)
    return [SourceMesh(local + np.array([left, top, lowest]), uvs, faces, image)]


def _grown(heights: Array) -> Array:
    """The heights with unknown vertices beside known ones set to the mean of these."""
    known = np.isfinite(heights)
    share = cv2.blur(known.astype(np.float64), (3, 3), borderType=cv2.BORDER_CONSTANT)
    total = cv2.blur(np.where(known, heights, 0.0), (3, 3), borderType=cv2.BORDER_CONSTANT)
    near = ~known & (share > 1e-6)
    return np.where(near, total / np.maximum(share, 1e-6), heights)


def _grown_picture(image: Image, shown: NDArray[np.bool_]) -> tuple[Image, NDArray[np.bool_]]:
    """The image with its border colours extended by `_GROWN` cells and a half, and the new mask."""
    if shown.all():
        return image, shown
    away, label = cv2.distanceTransformWithLabels(
        (~shown).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    rows, columns = np.nonzero(shown)
    nearest = np.zeros((int(label.max()) + 1, 3), np.uint8)
    nearest[label[rows, columns]] = image[rows, columns]
    return nearest[label], np.asarray(away) <= (_GROWN + 0.5) * TEXELS / CELLS


def _height(depth: Float32, base: float) -> Array:
    """Heights (m) of the drawn pixels, -inf where nothing was drawn."""
    return np.where(depth > 0, base + _EYE_M - depth.astype(np.float64), -np.inf)


def _placed(
    mesh: SourceMesh, mips: tuple[Image, ...], centre: Array, size: float
) -> TileMesh | None:
    """The triangles that may overlap a square, relative to its centre; None without any."""
    corners = mesh.positions[mesh.faces, :2] - centre[:2]
    low, high = corners.min(axis=1), corners.max(axis=1)
    near = mesh.faces[((low <= 0.51 * size) & (high >= -0.51 * size)).all(axis=1)]
    if len(near) == 0:
        return None
    positions = (mesh.positions - centre).astype(np.float32)
    return TileMesh(positions, mesh.uvs, near, mips, Pose.identity(), mesh.repeat)


def _drawn(tiles: Sequence[TileMesh], n: int, step: float) -> tuple[Image, Float32]:
    """RGB and depth (n, n) of a grid of rays that go down, `step` metres apart."""
    renderer = NumbaRenderer(StaticTiles(tiles), threads=1)
    focal = _EYE_M / step
    camera = Camera(n, n, focal, focal, n / 2, n / 2)
    view = renderer.draw(tiles, Pose(_DOWN, np.array([0.0, 0.0, _EYE_M])), camera)
    return view.rgb, view.depth


LEAF_TRIANGLES = 30_000


class Model(Protocol):
    """A mesh in its own axes (metres, z up).

    Equal models are the same mesh: a loaded mesh is cached for the next tile.
    """

    @property
    def name(self) -> str:
        """Name for errors."""
        ...

    @property
    def rules(self) -> ImportRules:
        """Limits of the import."""
        ...

    def load(self) -> list[SourceMesh]:
        """The whole mesh; one per texture."""
        ...

    def ecef(self, points: Array) -> Array:
        """ECEF metres (N, 3) of points (N, 3) in its axes."""
        ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class MeshGrid:
    """The quadtree over a mesh's x and y. size: metres of the root's side."""

    left: float
    top: float
    size: float
    levels: int


@dataclass(frozen=True)
class MeshTile:
    """Tile (column, row) of a level, 0 the coarsest; implements `TileSource`."""

    model: Model
    grid: MeshGrid
    level: int
    column: int
    row: int

    @property
    def name(self) -> str:
        """How errors name it."""
        return f"{self.model.name} {self.level}/{self.column}/{self.row}"

    @property
    def size(self) -> float:
        """Metres of the tile's side."""
        side: float = self.grid.size / 2**self.level
        return side

    def load(self) -> Sequence[SourceMesh]:
        """See `TileSource.load`."""
        meshes = _loaded(self.model)
        left, top = self.grid.left + self.column * self.size, self.grid.top - self.row * self.size
        if self.level == self.grid.levels - 1:
            parts = [crop_square(m, left, top, self.size) for m in meshes]
            local = [p for p in parts if p is not None]
        else:
            textured = list(zip(meshes, _mips(self.model), strict=True))
            local = render_height_field([textured], left, top, self.size)
        return [replace(m, positions=self.model.ecef(m.positions)) for m in local]


def bounds(model: Model) -> tuple[Array, Array]:
    """Lowest and highest corner (3,) of a model in its axes."""
    meshes = _loaded(model)
    low = np.min([m.positions.min(axis=0) for m in meshes], axis=0)
    high = np.max([m.positions.max(axis=0) for m in meshes], axis=0)
    return np.asarray(low), np.asarray(high)


def quadtree(model: Model) -> SourceNode:
    """The tile tree of a model, as deep as its triangles and texels require."""
    meshes = _loaded(model)
    low, high = bounds(model)
    extent = float((high - low)[:2].max()) * 1.0001
    shape = [(m.image.shape[1], m.image.shape[0]) for m in meshes]
    sizes = [
        texel_size(m.positions, m.uvs, m.faces, s)
        for m, s in zip(meshes, shape, strict=True)
        if not m.palette
    ]
    texels = extent / min(sizes) if sizes and min(sizes) > 0 else 0.0
    triangles = sum(len(m.faces) for m in meshes)
    leaves = max(texels / TEXELS, np.sqrt(triangles / LEAF_TRIANGLES), 1.0)
    grid = MeshGrid(float(low[0]), float(high[1]), extent, 1 + int(np.ceil(np.log2(leaves))))
    # One vertex far aside asks for squares of the finest texels all the way there.
    what = f"{model.name}, {extent:.0f} m wide with texels from {min(sizes, default=extent):.2g} m"
    model.rules.require("nodes", (4**grid.levels - 1) // 3, what)
    return _node(MeshTile(model, grid, 0, 0, 0))


def _node(tile: MeshTile) -> SourceNode:
    children = []
    if tile.level < tile.grid.levels - 1:
        for row in (2 * tile.row, 2 * tile.row + 1):
            for column in (2 * tile.column, 2 * tile.column + 1):
                children.append(_node(replace(tile, level=tile.level + 1, column=column, row=row)))
    return SourceNode(tile_error_m(tile.size) if children else 0.0, True, (tile,), children)


@lru_cache(maxsize=1)
def _loaded(model: Model) -> list[SourceMesh]:
    """The model's meshes, cached for the next tile of the same process."""
    return model.load()


@lru_cache(maxsize=1)
def _mips(model: Model) -> list[tuple[Image, ...]]:
    return [mips_of(m) for m in _loaded(model)]


def mips_of(mesh: SourceMesh) -> tuple[Image, ...]:
    """The mesh's texture and its coarser mip levels."""
    return (mesh.image,) if mesh.palette else build_mips(mesh.image)


_PADDING = 2  # texels around a packed chart


def crop_square(mesh: SourceMesh, left: float, top: float, size: float) -> SourceMesh | None:
    """The triangles with centroids in a square (x, y; metres) and their part of the texture; None
    without any. left, top: western and northern edge, m; size: side, m.
    """
    centroid = mesh.positions[mesh.faces, :2].mean(axis=1)
    here = (
        (centroid[:, 0] >= left)
        & (centroid[:, 0] < left + size)
        & (centroid[:, 1] <= top)
        & (centroid[:, 1] > top - size)
    )
    if not here.any():
        return None
    used, faces = np.unique(mesh.faces[here], return_inverse=True)
    part = replace(
        mesh,
        positions=mesh.positions[used],
        uvs=mesh.uvs[used],
        faces=faces.reshape(-1, 3).astype(np.int32),
        jpeg=None,
    )
    return part if mesh.repeat or mesh.palette else _repacked(part)


def _repacked(mesh: SourceMesh) -> SourceMesh:
    """The same mesh with the charts of its texture in a new, smaller image."""
    v = len(mesh.positions)
    edges = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    ones = np.ones(len(edges), bool)
    _, chart = connected_components(coo_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(v, v)))
    size = np.array(mesh.image.shape[1::-1])
    texels = np.clip(mesh.uvs.astype(np.float64), 0, 1) * size
    count = int(chart.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, texels)
    np.maximum.at(high, chart, texels)
    low = np.clip(np.floor(low) - _PADDING, 0, size).astype(np.int64)
    high = np.clip(np.ceil(high) + _PADDING, 0, size).astype(np.int64)
    places, (width, height) = pack_in_rows(high - low)
    if width * height >= size.prod():
        return mesh
    image = np.zeros((height, width, 3), np.uint8)
    for (x, y), (x0, y0), (x1, y1) in zip(places, low, high, strict=True):
        image[y : y + y1 - y0, x : x + x1 - x0] = mesh.image[y0:y1, x0:x1]
    uvs = (texels - low[chart] + places[chart]) / (width, height)
    return replace(mesh, uvs=uvs.astype(np.float32), image=image)


def pack_in_rows(sizes: NDArray[np.int64]) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Pack rectangles (N, 2: width, height) in rows; positions (N, 2) and total size."""
    limit = max(int(np.sqrt(1.1 * sizes.prod(axis=1).sum())), int(sizes[:, 0].max()))
    places = np.zeros_like(sizes)
    x = y = row = widest = 0
    for i in np.argsort(-sizes[:, 1], kind="stable"):
        width, height = (int(n) for n in sizes[i])
        if x + width > limit:
            x, y, row = 0, y + row, 0
        places[i] = x, y
        x, row = x + width, max(row, height)
        widest = max(widest, x)
    return places, (widest, y + row)
