"""Finds the map source in a folder, and whether there is only one way to import it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from localizer.errors import MapSourceError
from localizer.plain_files import files_of, without_hidden

MESHES = (".glb", ".gltf", ".obj")
RASTERS = (".tif", ".tiff", ".vrt")
TILESET = "tileset.json"
_LISTED = 12  # of what is found, in an error

# OpenDroneMap's result folder (its documentation, "Outputs").
_ODM_TILESETS = ("3d_tiles/model",)
_ODM_MESHES = (
    "odm_texturing/odm_textured_model_geo.obj",
    "odm_texturing_25d/odm_textured_model_geo.obj",
)
_ODM_OFFSETS = (
    "odm_georeferencing/coords.txt",
    "odm_georeferencing/odm_georeferencing_model_geo.txt",
)
_ODM_DSM, _ODM_ORTHOPHOTO = "odm_dem/dsm.tif", "odm_orthophoto/odm_orthophoto.tif"
# Beside a mesh of anybody's making.
_OFFSETS = ("georef.json", "georeference.json", "coords.txt", "offset.txt")


@dataclass(frozen=True)
class FoundSource:
    """A map source. sources: as `read_source` takes them; georeference: a mesh's file."""

    sources: tuple[Path, ...]
    georeference: Path | None = None

    @property
    def arguments(self) -> str:
        """As command-line arguments, quoted for a shell."""
        given = ("--georeference", self.georeference) if self.georeference else ()
        return shlex.join(map(str, (*self.sources, *given)))


def source_in(folder: Path, georeference_given: bool) -> FoundSource:
    """The source in a folder, if there is only one way to read it.

    A `tileset.json` directly in the folder is taken, whatever else is there. Otherwise the source
    is another tileset, an OpenDroneMap result, one mesh with its georeference, or two rasters.
    georeference_given: the user gave a file for the mesh, so none is needed in the folder.
    `MapSourceError` if there are several ways, with a `map build` command for each; if there is
    none, with the files found; or if the folder cannot be read.
    """
    if (folder / TILESET).is_file():
        return FoundSource((folder,))
    try:
        ways = list(_ways(folder, georeference_given))
        if len(ways) == 1:
            return ways[0]
        found = _found(folder)
    except OSError as error:
        raise MapSourceError(f"{folder}: cannot be read: {error}") from error
    if ways:
        lines = "\n".join(f"  companion map build {way.arguments} --out DIR" for way in ways)
        raise MapSourceError(f"{folder}: can be imported in several ways; choose one:\n{lines}")
    raise MapSourceError(
        f"{folder}: no {TILESET}, and {found}; pass a tileset, a mesh (.glb, .gltf, .obj) with "
        "--georeference FILE, or a DSM and an orthophoto (GeoTIFF) by name"
    )


def _ways(folder: Path, georeference_given: bool) -> Iterator[FoundSource]:
    for path in without_hidden(folder.glob("*tileset*.json")):  # under another name
        yield FoundSource((path,))
    for name in _ODM_TILESETS:
        if (folder / name / TILESET).is_file():
            yield FoundSource((folder / name,))
    offset = _first(folder, _ODM_OFFSETS)
    for mesh in filter(Path.is_file, (folder / name for name in _ODM_MESHES)):
        if offset or georeference_given:
            yield FoundSource((mesh,), None if georeference_given else offset)
    rasters = (folder / _ODM_DSM, folder / _ODM_ORTHOPHOTO)
    if all(map(Path.is_file, rasters)):
        yield FoundSource(rasters)
    offset = _first(folder, _OFFSETS)
    meshes = files_of(folder, MESHES)
    if offset or georeference_given:
        yield from (FoundSource((m,), None if georeference_given else offset) for m in meshes)
    plain = tuple(files_of(folder, RASTERS))
    if len(plain) == 2:
        yield FoundSource(plain)


def _found(folder: Path) -> str:
    """Names of the files in a folder, two levels deep, that an importer may read."""
    deep = [folder, *without_hidden(p for p in folder.iterdir() if p.is_dir())]
    files = [p for place in deep for p in files_of(place, (*MESHES, *RASTERS))]
    files += [p.parent / p.name for p in sorted(folder.glob(f"*/{TILESET}"))]
    if not files:
        return "nothing else that can be imported"
    shown = ", ".join(str(p.relative_to(folder)) for p in files[:_LISTED])
    more = f" and {len(files) - _LISTED} more" if len(files) > _LISTED else ""
    return f"what it holds is not one source: {shown}{more}"


def _first(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / n for n in names if (folder / n).is_file()), None)
