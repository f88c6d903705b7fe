"""Quadtree of a mesh: leaves are cut out of it, coarser levels are rendered from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from localizer.geometry.pose import Array
from localizer.map.building.cutting import crop_square
from localizer.map.building.staging import texel_size
from localizer.map.building.topdown import TEXELS, render_height_field, tile_error_m
from localizer.map.cache.tile import build_mips
from localizer.map.importers.rules import ImportRules
from localizer.map.source import SourceMesh, SourceNode
from localizer.types import Image

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
