"""Selects the importer of a map source, and adds levels of detail where it has none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.geometry.geo import Geodetic, LocalFrame, geodetic_from_ecef
from localizer.geometry.pose import Array
from localizer.map.building.options import BuildOptions
from localizer.map.building.quadtree import (
    Textured,
    bounds,
    mips_of,
    quadtree,
    render_height_field,
    tile_error_m,
)
from localizer.map.importers.folder import MESHES, RASTERS, FoundSource, source_in
from localizer.map.importers.georeference import Georeference, UpAxis, read_georeference
from localizer.map.importers.mesh import MeshFile, obj_materials
from localizer.map.importers.raster import read_rasters
from localizer.map.importers.referenced_files import files_beside
from localizer.map.importers.rules import ImportRules, require_plain_file
from localizer.map.importers.tiles3d import ContentFile, read_tileset
from localizer.map.source import SourceMesh, SourceNode, SourceTree, TileSource

GROUP = 4  # tiles that need no coarser one over them
MAX_TRIANGLES, MAX_TEXELS = 250_000, 4096**2  # of a tile; larger leaves are cut
_SMALL_BYTES = 1 << 20  # files up to here are not larger


@dataclass(frozen=True)
class ContentModel:
    """A tile's content in ENU axes about an origin; implements `Model`. key: identifies it."""

    content: ContentFile = field(compare=False)
    origin: Geodetic
    key: bytes

    @property
    def name(self) -> str:
        """How errors name it."""
        return self.content.name

    @property
    def rules(self) -> ImportRules:
        """See `Model.rules`."""
        return self.content.rules

    def load(self) -> list[SourceMesh]:
        """See `Model.load`."""
        return _in_frame(self.content, LocalFrame(self.origin))

    def ecef(self, points: Array) -> Array:
        """See `Model.ecef`."""
        return LocalFrame(self.origin).ecef_from_enu.apply(points)


@dataclass(frozen=True, eq=False)
class TopViewTile:
    """Coarser tile: the surface of other tiles seen from above; implements `TileSource`. left, top,
    size: its square, ENU metres about the origin.
    """

    parts: tuple[ContentFile, ...]
    origin: Geodetic
    left: float
    top: float
    size: float

    @property
    def name(self) -> str:
        """How errors name it."""
        more = f" and {len(self.parts) - 1} more" if len(self.parts) > 1 else ""
        return f"coarser level of {self.parts[0].name}{more}"

    def load(self) -> Sequence[SourceMesh]:
        """See `TileSource.load`."""
        frame = LocalFrame(self.origin)
        made = render_height_field(self._drawn_parts(frame), self.left, self.top, self.size)
        return [replace(m, positions=frame.ecef_from_enu.apply(m.positions)) for m in made]

    def _drawn_parts(self, frame: LocalFrame) -> Iterator[list[Textured]]:
        for part in self.parts:
            try:
                meshes = _in_frame(part, frame)
            except MapSourceError:
                continue  # told where the part itself is imported
            yield [(mesh, mips_of(mesh)) for mesh in meshes]


def with_levels(tree: SourceTree) -> SourceTree:
    """The tree with huge leaves cut into smaller tiles, and with coarser levels if no tile lies
    below another, there are over `GROUP` leaves, and each states its corners. `MapSourceError` if a
    huge leaf cannot be read.
    """
    lat, lon, h = (float(x) for x in geodetic_from_ecef(tree.centre))
    origin = Geodetic(lat, lon, h)
    nodes = [node for node in tree.root.walk() if node.tiles and not node.children]
    cut = {id(node): _cut(node, origin) for node in nodes if _is_huge(node)}
    leaves = [
        _Leaf.of(node.tiles, cut.get(id(node), node), node.corners, origin)
        for node in nodes
        if node.corners is not None
    ]
    if _is_flat(tree.root) and len(nodes) > GROUP and len(leaves) == len(nodes):
        return replace(tree, root=_grouped(leaves, origin))
    return replace(tree, root=_replaced(tree.root, cut))


def _is_flat(root: SourceNode) -> bool:
    """Whether no tile with content has another one below it."""
    return not any(
        node.tiles and any(child.tiles for below in node.children for child in below.walk())
        for node in root.walk()
    )


def _is_huge(node: SourceNode) -> bool:
    for tile in node.tiles:
        if isinstance(tile, ContentFile) and tile.size_bytes() > _SMALL_BYTES:
            try:
                triangles, texels = tile.weight()
            except MapSourceError:
                return False  # told with the tile's name when it is imported
            if triangles > MAX_TRIANGLES or texels > MAX_TEXELS:
                return True
    return False


def _cut(node: SourceNode, origin: Geodetic) -> SourceNode:
    """A leaf as a tree of smaller tiles; each of its contents is cut separately."""
    roots = []
    for tile in node.tiles:
        assert isinstance(tile, ContentFile)
        key = tile.name.encode() + tile.ecef_from_tile.tobytes()
        roots.append(quadtree(ContentModel(tile, origin, key)))
    return roots[0] if len(roots) == 1 else SourceNode(roots[0].geometric_error, False, (), roots)


def _replaced(node: SourceNode, cut: dict[int, SourceNode]) -> SourceNode:
    if id(node) in cut:
        return cut[id(node)]
    return replace(node, children=[_replaced(child, cut) for child in node.children])


@dataclass(frozen=True, eq=False)
class _Leaf:
    """A leaf of a flat tileset. node: itself, or its cut tree; low, high: (2,) of its box, ENU."""

    node: SourceNode
    parts: tuple[ContentFile, ...]
    low: Array
    high: Array

    @classmethod
    def of(
        cls, tiles: Sequence[TileSource], node: SourceNode, corners: Array, origin: Geodetic
    ) -> _Leaf:
        enu = LocalFrame(origin).ecef_from_enu.inverse.apply(corners)[:, :2]
        parts = tuple(t for t in tiles if isinstance(t, ContentFile))
        return cls(node, parts, enu.min(axis=0), enu.max(axis=0))


def _grouped(leaves: list[_Leaf], origin: Geodetic) -> SourceNode:
    """Coarser tiles over groups of leaves, by quarters; each tile shows exactly its leaves."""
    low = np.min([leaf.low for leaf in leaves], axis=0)
    high = np.max([leaf.high for leaf in leaves], axis=0)
    size = 1.0001 * float((high - low).max())
    parts = tuple(part for leaf in leaves for part in leaf.parts)
    tile = TopViewTile(parts, origin, float(low[0]), float(high[1]), size)
    children = [leaf.node for leaf in leaves]
    if len(leaves) > GROUP:
        middles = np.array([0.5 * (leaf.low + leaf.high) for leaf in leaves])
        quarter = (middles > np.median(middles, axis=0)) @ (1, 2)
        groups = [
            [leaf for leaf, q in zip(leaves, quarter, strict=True) if q == k] for k in range(4)
        ]
        if max(map(len, groups)) < len(leaves):
            children = [
                _grouped(group, origin) if len(group) > 1 else group[0].node
                for group in groups
                if group
            ]
    return SourceNode(tile_error_m(size), True, (tile,), children, stands_in=False)


def _in_frame(content: ContentFile, frame: LocalFrame) -> list[SourceMesh]:
    """A tile's meshes in the frame's ENU axes."""
    enu_from_ecef = frame.ecef_from_enu.inverse
    meshes = (m for m in content.load() if len(m.faces))
    return [replace(m, positions=enu_from_ecef.apply(m.positions)) for m in meshes]


_IMPORTABLE = (
    "3D Tiles (tileset.json or its folder), an OpenDroneMap result folder, a mesh "
    "(.glb, .gltf, .obj) with a georeference, or a DSM and an orthophoto (GeoTIFF)"
)


def find_source(
    sources: Sequence[Path], georeference: Georeference | Path | None
) -> tuple[tuple[Path, ...], Georeference | Path | None]:
    """The sources to import, as given or as found in a folder, with their georeference (None: none
    needed or found). `MapSourceError` if a path does not exist.
    """
    for path in sources:
        if not path.exists():
            raise MapSourceError(f"{path}: no such file or folder")
        if not path.is_dir():
            require_plain_file(path)
    found = FoundSource(tuple(sources))
    if len(sources) == 1 and sources[0].is_dir():
        found = source_in(sources[0], georeference is not None)
    return found.sources, georeference if georeference is not None else found.georeference


def read_source(
    sources: Sequence[Path],
    georeference: Georeference | Path | None = None,
    options: BuildOptions | None = None,
) -> SourceTree:
    """The tile tree of what `find_source` found. georeference: of a mesh, instead of that of the
    options. `MapSourceError` if it cannot be imported.
    """
    options = options or BuildOptions()
    rules = options.rules
    if all(path.suffix.lower() in RASTERS for path in sources):
        return read_rasters(sources, rules, height_unit=options.height_unit, nodata=options.nodata)
    if len(sources) > 1:
        raise MapSourceError("several sources can only be a DSM and an orthophoto")
    if sources[0].suffix.lower() in MESHES:
        return _read_mesh(sources[0], georeference, options)
    if sources[0].is_dir() or sources[0].suffix.lower() == ".json":
        return with_levels(read_tileset(sources[0], rules, options.up_axis))
    raise MapSourceError(f"{sources[0]}: not a source that can be imported: {_IMPORTABLE}")


def _read_mesh(
    source: Path, georeference: Georeference | Path | None, options: BuildOptions
) -> SourceTree:
    if georeference is None:
        raise GeoreferenceError(
            f"{source}: a mesh does not say where on Earth it stands; give a georeference "
            "file (--georeference)"
        )
    if isinstance(georeference, Path):
        require_plain_file(georeference)
        georeference = read_georeference(georeference)
    return mesh_tree(source, georeference, options)


def mesh_tree(path: Path, georeference: Georeference, options: BuildOptions) -> SourceTree:
    """The tree of a mesh. Default up axis: y for glTF, z for OBJ."""
    axis: UpAxis = options.up_axis or ("z" if path.suffix.lower() == ".obj" else "y")
    model = MeshFile(path, axis, georeference, options.rules)
    low, high = bounds(model)
    # A mesh about an origin keeps that as the world's; one in a CRS is given its middle.
    middle = [*(0.5 * (low + high))[:2], low[2]] if georeference.origin is None else [0.0, 0.0, 0.0]
    centre = georeference.ecef(np.array([middle]))[0]
    files = (path, *files_beside(path))
    doubts = obj_materials(path)[1] if path.suffix.lower() == ".obj" else ()
    warnings = [f"{path.name}: {text}" for text in doubts]
    warnings += georeference.doubts(np.array([low, high]), path, options.rules)
    if georeference.unread:
        warnings.append(
            f"{path.name}: not read of its georeference: {', '.join(georeference.unread)}"
        )
    return SourceTree(
        quadtree(model),
        centre,
        None,
        "",
        files,
        options=f"{georeference} {axis}",
        up_axis=axis,
        warnings=tuple(warnings),
    )
