"""Telling sources apart: which importer reads what."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.map.building.levels import with_levels
from localizer.map.building.quadtree import bounds, quadtree
from localizer.map.importers.folder import MESHES, RASTERS, FoundSource, source_in
from localizer.map.importers.georeference import Georeference, UpAxis, read_georeference
from localizer.map.importers.mesh import MeshFile
from localizer.map.importers.raster import read_rasters
from localizer.map.importers.referenced_files import files_beside
from localizer.map.importers.tiles3d import read_tileset
from localizer.map.source import SourceTree

_IMPORTABLE = (
    "3D Tiles (tileset.json or its folder), an OpenDroneMap result folder, a mesh "
    "(.glb, .gltf, .obj) with a georeference, or a DSM and an orthophoto (GeoTIFF)"
)


def find_source(
    sources: Sequence[Path], georeference: Georeference | Path | None
) -> tuple[tuple[Path, ...], Georeference | Path | None]:
    """What to import: the sources as given, or what a folder holds, with its georeference."""
    for path in sources:
        if not path.exists():
            raise MapSourceError(f"{path}: no such file or folder")
    found = FoundSource(tuple(sources))
    if len(sources) == 1 and sources[0].is_dir():
        found = source_in(sources[0], georeference is not None)
    return found.sources, georeference if georeference is not None else found.georeference


def read_source(
    sources: Sequence[Path],
    georeference: Georeference | Path | None = None,
    up_axis: UpAxis | None = None,
) -> SourceTree:
    """The tile tree of what `find_source` found."""
    if all(path.suffix.lower() in RASTERS for path in sources):
        return read_rasters(sources)
    if len(sources) > 1:
        raise MapSourceError("several sources can only be a DSM and an orthophoto")
    if sources[0].suffix.lower() in MESHES:
        return _read_mesh(sources[0], georeference, up_axis)
    if sources[0].is_dir() or sources[0].suffix.lower() == ".json":
        return with_levels(read_tileset(sources[0]))
    raise MapSourceError(f"{sources[0]}: not a source that can be imported: {_IMPORTABLE}")


def _read_mesh(
    source: Path, georeference: Georeference | Path | None, up_axis: UpAxis | None
) -> SourceTree:
    if georeference is None:
        raise GeoreferenceError(
            f"{source}: a mesh does not say where on Earth it stands; give a georeference "
            "file (--georeference)"
        )
    if isinstance(georeference, Path):
        georeference = read_georeference(georeference)
    return mesh_tree(source, georeference, up_axis)


def mesh_tree(path: Path, georeference: Georeference, up_axis: UpAxis | None) -> SourceTree:
    """The tree of a mesh. up_axis: else y for glTF and z for OBJ."""
    axis: UpAxis = up_axis or ("z" if path.suffix.lower() == ".obj" else "y")
    model = MeshFile(path, axis, georeference)
    low, high = bounds(model)
    # A mesh about an origin keeps that as the world's; one in a CRS is given its middle.
    middle = [*(0.5 * (low + high))[:2], low[2]] if georeference.origin is None else [0.0, 0.0, 0.0]
    centre = georeference.ecef(np.array([middle]))[0]
    options = f"{georeference} {axis}"
    files = (path, *files_beside(path))
    return SourceTree(quadtree(model), centre, None, "", files, options=options)
