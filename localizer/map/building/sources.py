"""Selects the importer of a map source."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.map.building.levels import with_levels
from localizer.map.building.options import BuildOptions
from localizer.map.building.quadtree import bounds, quadtree
from localizer.map.importers.folder import MESHES, RASTERS, FoundSource, source_in
from localizer.map.importers.georeference import Georeference, UpAxis, read_georeference
from localizer.map.importers.mesh import MeshFile, obj_materials
from localizer.map.importers.raster import read_rasters
from localizer.map.importers.referenced_files import files_beside
from localizer.map.importers.rules import require_plain_file
from localizer.map.importers.tiles3d import read_tileset
from localizer.map.source import SourceTree

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
