"""Telling sources apart: which importer reads what."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from localizer.errors import GeoreferenceError, MapSourceError
from localizer.map.folder import MESHES, RASTERS, FoundSource, source_in
from localizer.map.georeference import Georeference, UpAxis, read_georeference
from localizer.map.levels import with_levels
from localizer.map.mesh import read_mesh
from localizer.map.raster import read_rasters
from localizer.map.source import SourceTree
from localizer.map.tiles3d import read_tileset

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
    return read_mesh(source, georeference, up_axis)
