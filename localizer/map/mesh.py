"""glTF, GLB and OBJ meshes with a georeference: cut into tiles, coarser levels made for them.

Leaves of a quadtree take the triangles whose centroids they hold, with the parts of the texture
that those show packed anew. Coarser levels are height fields drawn from above: seen from where they
are used (several pixels to a grid step) that is what is left of a surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from localizer.camera import Camera
from localizer.errors import MapSourceError
from localizer.map.georeference import Georeference, UpAxis
from localizer.map.gltf import palette_mesh, read_gltf
from localizer.map.heightmesh import ERROR_PER_STEP, height_mesh
from localizer.map.source import SourceMesh, SourceNode, SourceTree
from localizer.map.staging import texel_size
from localizer.map.tile import TileMesh, build_mips
from localizer.map.tiles3d import inside, read_file
from localizer.pose import Array, Pose
from localizer.render.base import StaticTiles
from localizer.render.numba_raster import NumbaRenderer
from localizer.types import Float32, Image

SUFFIXES = (".glb", ".gltf", ".obj")
TEXELS = 512  # of a tile's side, about
CELLS = 128  # of a made-up coarse tile's side
LEAF_TRIANGLES = 30_000
_EYE_M = 50_000.0  # height of the camera that draws coarse levels: rays all but parallel
_PADDING = 2  # texels around a packed chart
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
_DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # camera axes: x east, y south


@dataclass(frozen=True)
class MeshGrid:
    """The quadtree over a mesh's x and y. size: metres of the root's side."""

    left: float
    top: float
    size: float
    levels: int


@dataclass(frozen=True)
class MeshTile:
    """Tile (column, row) of a level, 0 the coarsest; one `TileSource`."""

    path: Path
    up_axis: UpAxis
    georeference: Georeference
    grid: MeshGrid
    level: int
    column: int
    row: int

    @property
    def name(self) -> str:
        """How errors name it."""
        return f"{self.path.name} {self.level}/{self.column}/{self.row}"

    @property
    def size(self) -> float:
        """Metres of the tile's side."""
        return self.grid.size / 2**self.level

    def load(self) -> Sequence[SourceMesh]:
        """See `TileSource.load`."""
        meshes = _model(self.path, self.up_axis)
        left, top = self.grid.left + self.column * self.size, self.grid.top - self.row * self.size
        if self.level == self.grid.levels - 1:
            parts = [_cropped(m, left, top, self.size) for m in meshes]
            local = [p for p in parts if p is not None]
        else:
            mips = _mips(self.path, self.up_axis)
            local = _seen_from_above(meshes, mips, left, top, self.size)
        return [replace(m, positions=self.georeference.ecef(m.positions)) for m in local]


def read_mesh(path: Path, georeference: Georeference, up_axis: UpAxis | None) -> SourceTree:
    """The tree of a mesh. up_axis: else y for glTF and z for OBJ."""
    axis: UpAxis = up_axis or ("z" if path.suffix.lower() == ".obj" else "y")
    meshes = _model(path, axis)
    low = np.min([m.positions.min(axis=0) for m in meshes], axis=0)
    high = np.max([m.positions.max(axis=0) for m in meshes], axis=0)
    extent = float((high - low)[:2].max()) * 1.0001
    sizes = [texel_size(m.positions, m.uvs, m.faces, _size(m)) for m in meshes if not m.palette]
    texels = extent / min(sizes) if sizes and min(sizes) > 0 else 0.0
    triangles = sum(len(m.faces) for m in meshes)
    leaves = max(texels / TEXELS, np.sqrt(triangles / LEAF_TRIANGLES), 1.0)
    grid = MeshGrid(float(low[0]), float(high[1]), extent, 1 + int(np.ceil(np.log2(leaves))))
    # A mesh about an origin keeps that as the world's; one in a CRS is given its middle.
    middle = [*(0.5 * (low + high))[:2], low[2]] if georeference.origin is None else [0.0, 0.0, 0.0]
    root = MeshTile(path, axis, georeference, grid, 0, 0, 0)
    return SourceTree(
        _node(root),
        georeference.ecef(np.array([middle]))[0],
        None,
        "",
        (path,),
        options=f"{georeference} {axis}",
    )


def _node(tile: MeshTile) -> SourceNode:
    children = []
    if tile.level < tile.grid.levels - 1:
        for row in (2 * tile.row, 2 * tile.row + 1):
            for column in (2 * tile.column, 2 * tile.column + 1):
                children.append(_node(replace(tile, level=tile.level + 1, column=column, row=row)))
    error = ERROR_PER_STEP * tile.size / CELLS if children else 0.0
    return SourceNode(error, True, (tile,), children)


@lru_cache(maxsize=1)
def _model(path: Path, up_axis: UpAxis) -> list[SourceMesh]:
    """The whole mesh, z up; one per texture. Kept for the next tile of the same process."""
    if path.suffix.lower() == ".obj":
        meshes = _read_obj(path)
    else:
        folder = path.parent.resolve()
        meshes, rtc = read_gltf(read_file(path), lambda uri: read_file(inside(folder, folder, uri)))
        meshes = [replace(m, positions=m.positions + rtc) for m in meshes]
    meshes = [m for m in meshes if len(m.faces)]
    if not meshes:
        raise MapSourceError(f"{path}: holds no triangles")
    if up_axis == "y":
        meshes = [replace(m, positions=m.positions @ _Z_UP_FROM_Y_UP.T) for m in meshes]
    return meshes


@lru_cache(maxsize=1)
def _mips(path: Path, up_axis: UpAxis) -> list[tuple[Image, ...]]:
    meshes = _model(path, up_axis)
    return [(m.image,) if m.palette else build_mips(m.image) for m in meshes]


def _read_obj(path: Path) -> list[SourceMesh]:
    try:
        loaded = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh raises whatever its readers meet
        raise MapSourceError(f"{path}: cannot be read as OBJ: {error!r}") from error
    return [_from_trimesh(g) for g in loaded.geometry.values() if hasattr(g, "faces")]


def _from_trimesh(mesh: Any) -> SourceMesh:
    positions = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int32)
    uv = getattr(mesh.visual, "uv", None)
    material = getattr(mesh.visual, "material", None)
    picture = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if uv is None or picture is None:
        colours = np.asarray(mesh.visual.face_colors, np.uint8)[:, :3]
        return palette_mesh(positions, faces, colours)
    uvs = np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]).astype(np.float32)  # v upwards there
    image = np.asarray(picture.convert("RGB"), np.uint8)
    outside = uvs.min() < -0.01 or uvs.max() > 1.01
    return SourceMesh(positions, uvs, faces, image, repeat=bool(outside))


def _size(mesh: SourceMesh) -> tuple[int, int]:
    return mesh.image.shape[1], mesh.image.shape[0]


def _cropped(mesh: SourceMesh, left: float, top: float, size: float) -> SourceMesh | None:
    """The triangles whose centroids lie in a square, with just their part of the texture."""
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
    size = np.array(_size(mesh))
    texels = np.clip(mesh.uvs.astype(np.float64), 0, 1) * size
    count = int(chart.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, texels)
    np.maximum.at(high, chart, texels)
    low = np.clip(np.floor(low) - _PADDING, 0, size).astype(np.int64)
    high = np.clip(np.ceil(high) + _PADDING, 0, size).astype(np.int64)
    places, (width, height) = _shelves(high - low)
    if width * height >= size.prod():
        return mesh
    image = np.zeros((height, width, 3), np.uint8)
    for (x, y), (x0, y0), (x1, y1) in zip(places, low, high, strict=True):
        image[y : y + y1 - y0, x : x + x1 - x0] = mesh.image[y0:y1, x0:x1]
    uvs = (texels - low[chart] + places[chart]) / (width, height)
    return replace(mesh, uvs=uvs.astype(np.float32), image=image)


def _shelves(sizes: NDArray[np.int64]) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Places (N, 2) of rectangles (N, 2: width, height) packed in rows, and their extent."""
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


def _seen_from_above(
    meshes: Sequence[SourceMesh],
    mips: Sequence[tuple[Image, ...]],
    left: float,
    top: float,
    size: float,
) -> list[SourceMesh]:
    """A square of the mesh as a textured height field."""
    # About the tile's centre, and a height that keeps float32 small.
    centre = np.array([left + size / 2, top - size / 2, meshes[0].positions[0, 2]])
    pairs = zip(meshes, mips, strict=True)
    tiles = [t for m, chain in pairs if (t := _placed(m, chain, centre, size)) is not None]
    if not tiles:
        return []
    step = size / CELLS
    _, heights = _drawn(tiles, CELLS + 1, step)
    image, depth = _drawn(tiles, TEXELS, size / TEXELS)
    z = np.ma.masked_array(_EYE_M - heights.astype(np.float64), heights == 0)
    made = height_mesh(z, depth > 0, (step, step), lossless=False)
    if made is None:
        return []
    local, faces = made
    uvs = (local[:, :2] * (1, -1) / size).astype(np.float32)
    return [SourceMesh(local + np.array([left, top, centre[2]]), uvs, faces, image)]


def _placed(
    mesh: SourceMesh, mips: tuple[Image, ...], centre: Array, size: float
) -> TileMesh | None:
    """The triangles that may meet a square, relative to its centre."""
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
