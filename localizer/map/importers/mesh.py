"""glTF, GLB and OBJ meshes with a georeference: cut into tiles, coarser levels made for them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.cache.tile import mesh_fault
from localizer.map.importers.georeference import Georeference, UpAxis
from localizer.map.importers.gltf import read_gltf
from localizer.map.importers.referenced_files import colour_pictures, files_beside
from localizer.map.importers.rules import DEFAULT_RULES, ImportRules, require_plain_file
from localizer.map.importers.textures import palette_mesh, require_readable
from localizer.map.importers.tiles3d import inside, read_file
from localizer.map.source import SourceMesh

_LINE_BYTES = 1 << 16  # of an OBJ
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True)
class MeshFile:
    """A mesh file and where it stands; one `Model`."""

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
                data, lambda uri: read_file(inside(folder, folder, uri), rules), rules
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


def _read_obj(path: Path, rules: ImportRules) -> list[SourceMesh]:
    require_plain_file(path)
    rules.require("file_bytes", path.stat().st_size, path)
    _require_short_lines(path)
    for beside in files_beside(path):
        if beside.exists() and not beside.is_dir():
            require_plain_file(beside)
            rules.require("file_bytes", beside.stat().st_size, beside)
    for picture in colour_pictures(path)[0].values():
        require_readable(picture, rules)
    try:
        loaded = trimesh.load_scene(path, process=False)
        meshes = [_from_trimesh(g) for g in loaded.geometry.values() if hasattr(g, "faces")]
    except MapSourceError:
        raise
    except Exception as error:  # trimesh raises whatever its readers meet
        raise MapSourceError(f"{path}: cannot be read as OBJ: {error!r}") from error
    rules.require("vertices", sum(len(m.positions) for m in meshes), path)
    return meshes


def _require_short_lines(path: Path) -> None:
    """One face of 900,000 corners took more than 90 s to be made triangles of."""
    with path.open("rb") as file:
        while line := file.readline(_LINE_BYTES + 1):
            if len(line) > _LINE_BYTES:
                raise MapSourceError(
                    f"{path}: a line is longer than {_LINE_BYTES} bytes: no face has so many "
                    "corners; export it as triangles"
                )


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
