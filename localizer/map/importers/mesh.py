"""Imports georeferenced glTF, GLB and OBJ meshes: cuts tiles and makes coarser levels."""

from __future__ import annotations

import io
import mmap
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image as PillowImage

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.cache.tile import mesh_fault
from localizer.map.importers.georeference import Georeference, UpAxis
from localizer.map.importers.gltf import read_gltf
from localizer.map.importers.materials import (
    MtlMaterial,
    cut_out,
    palette_mesh,
    read_mtl,
    require_readable,
)
from localizer.map.importers.referenced_files import files_beside
from localizer.map.importers.rules import DEFAULT_RULES, ImportRules, require_plain_file
from localizer.map.importers.tiles3d import read_file, resolve_inside
from localizer.map.source import SourceMesh
from localizer.plain_files import decode_lenient

_LINE_BYTES = 1 << 16  # of an OBJ
_FACE = re.compile(rb"(?m)^[ \t]*f[ \t]")
_USE = re.compile(rb"(?im)^[ \t]*usemtl[ \t]+([^\r\n]*)")
_MENTIONS_LIBRARY = re.compile(rb"(?im)^(?:\xef\xbb\xbf)?[ \t]*mtllib[ \t]")
_OWN_LIBRARY = "materials.mtl"
_OPAQUE = 128
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True)
class MeshFile:
    """A georeferenced mesh file; implements `Model`."""

    path: Path
    up_axis: UpAxis
    georeference: Georeference
    rules: ImportRules = DEFAULT_RULES

    @property
    def name(self) -> str:
        """How errors name it."""
        return self.path.name

    def load(self) -> list[SourceMesh]:
        """See `Model.load`."""
        if self.path.suffix.lower() == ".obj":
            meshes = _read_obj(self.path, self.rules)
        else:
            folder = self.path.parent.resolve()
            rules = self.rules
            data = read_file(self.path, rules)
            meshes, rtc = read_gltf(
                data, lambda uri: read_file(resolve_inside(folder, folder, uri), rules), rules
            )
            meshes = [replace(m, positions=m.positions + rtc) for m in meshes]
        meshes = [m for m in meshes if len(m.faces)]
        if not meshes:
            raise MapSourceError(f"{self.path}: holds no triangles")
        for mesh in meshes:
            fault = mesh_fault(mesh.positions, mesh.uvs, mesh.faces)
            if fault is not None:
                raise MapSourceError(f"{self.path}: {fault}")
        if not any(_has_area(m) for m in meshes):
            raise MapSourceError(f"{self.path}: its triangles have no area")
        if self.up_axis == "y":
            meshes = [replace(m, positions=m.positions @ _Z_UP_FROM_Y_UP.T) for m in meshes]
        return meshes

    def ecef(self, points: Array) -> Array:
        """See `Model.ecef`."""
        return self.georeference.ecef(points)


def _has_area(mesh: SourceMesh) -> bool:
    a, b, c = (mesh.positions[mesh.faces[:, i]] for i in range(3))
    return bool(np.any(np.cross(b - a, c - a)))


def obj_materials(path: Path) -> tuple[dict[str, MtlMaterial], tuple[str, ...]]:
    """The materials of an OBJ's libraries by name, and its flaws as sentences: missing textures,
    libraries or materials, faces without a texture.
    """
    libraries = [p for p in files_beside(path) if p.suffix.lower() == ".mtl" and p.is_file()]
    found = [m for library in libraries for m in read_mtl(library, path.parent)]
    doubts = [f"its texture {name!r} is not there" for m in found for name in m.missing]
    if not path.stat().st_size:  # which cannot be mapped
        return {}, ()
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        if not libraries and _MENTIONS_LIBRARY.search(text):
            doubts.append("its material library is not there: it has no picture")
        used = {decode_lenient(match[1]).strip() for match in _USE.finditer(text)}
        unknown = sorted(used - {m.name for m in found} - {""})
        if unknown:
            doubts.append(
                f"{len(unknown)} of its materials are in no library (newmtl), first "
                f"{unknown[0]!r}: their faces have no image"
            )
        if len(found) > 1 and not _names_first_face(text):
            doubts.append(
                f"faces name no material (usemtl) and its library has {len(found)}: they are grey"
            )
    if found and not any(m.picture or m.missing for m in found):
        doubts.append("its materials have no picture, only colours")
    return {m.name: m for m in found}, tuple(dict.fromkeys(doubts))


def _read_obj(path: Path, rules: ImportRules) -> list[SourceMesh]:
    require_plain_file(path)
    rules.require("file_bytes", path.stat().st_size, path)
    _require_short_lines(path)
    for beside in files_beside(path):
        if beside.exists() and not beside.is_dir():
            require_plain_file(beside)
            rules.require("file_bytes", beside.stat().st_size, beside)
    materials, _ = obj_materials(path)
    for material in materials.values():
        for picture in (material.picture, material.mask):
            if picture is not None:
                require_readable(picture, rules)
    # trimesh is told the names of the materials alone: their pictures are read here.
    names = "".join(f"newmtl {name}\nKd 1 1 1\n" for name in materials)
    try:
        loaded = trimesh.load_scene(
            io.BytesIO(_with_materials(path.read_bytes(), materials)),
            file_type="obj",
            resolver=trimesh.resolvers.ZipResolver({_OWN_LIBRARY: io.BytesIO(names.encode())}),
            process=False,
        )
        meshes = [_from_trimesh(g, materials) for g in loaded.geometry.values()
                  if hasattr(g, "faces")]  # fmt: skip
    except MapSourceError:
        raise
    except Exception as error:  # trimesh raises whatever its readers meet
        raise MapSourceError(f"{path}: cannot be read as OBJ: {error!r}") from error
    rules.require("vertices", sum(len(m.positions) for m in meshes), path)
    return meshes


def _with_materials(text: bytes, materials: Mapping[str, MtlMaterial]) -> bytes:
    """An OBJ with its own library named first; faces before any usemtl get the only material."""
    text = _USE.sub(rb"usemtl \1", text.removeprefix(b"\xef\xbb\xbf"))
    if len(materials) == 1 and not _names_first_face(text) and (face := _FACE.search(text)):
        (name,) = materials
        text = text[: face.start()] + f"usemtl {name}\n".encode() + text[face.start() :]
    return f"mtllib {_OWN_LIBRARY}\n".encode() + text


def _names_first_face(text: bytes | mmap.mmap) -> bool:
    """Whether a usemtl stands before the first face."""
    face, use = _FACE.search(text), _USE.search(text)
    return face is None or (use is not None and use.start() < face.start())


def _require_short_lines(path: Path) -> None:
    """`MapSourceError` for a face with very many corners, which takes minutes to triangulate."""
    with path.open("rb") as file:
        while line := file.readline(_LINE_BYTES + 1):
            if len(line) > _LINE_BYTES:
                raise MapSourceError(
                    f"{path}: a line is longer than {_LINE_BYTES} bytes: no face has so many "
                    "corners; export it as triangles"
                )


def _from_trimesh(mesh: Any, materials: Mapping[str, MtlMaterial]) -> SourceMesh:
    positions = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int32)
    uv = getattr(mesh.visual, "uv", None)
    named = getattr(getattr(mesh.visual, "material", None), "name", None)
    material = materials.get(str(named))
    if uv is None or material is None or material.picture is None:
        if material is None and hasattr(mesh.visual, "face_colors"):  # of the vertices, or grey
            colours = np.asarray(mesh.visual.face_colors, np.uint8)[:, :3]
        else:
            shade = np.array((material or MtlMaterial("")).colour).clip(0.0, 1.0)
            colours = np.tile(np.rint(255 * shade).astype(np.uint8), (len(faces), 1))
        return palette_mesh(positions, faces, colours)
    uv = np.asarray(uv, np.float64) * material.scale + material.offset
    uvs = np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]).astype(np.float32)  # v upwards there
    with PillowImage.open(material.picture) as picture:
        image = np.asarray(picture.convert("RGB"), np.uint8)
    repeat = not material.clamped and bool(uvs.min() < -0.01 or uvs.max() > 1.01)
    if material.mask is not None:
        with PillowImage.open(material.mask) as picture:
            opaque = np.asarray(picture.convert("L"), np.uint8) >= _OPAQUE
        positions, uvs, faces = cut_out(positions, uvs, faces, opaque, repeat=repeat)
    return SourceMesh(positions, uvs, faces, image, repeat=repeat)
