"""Reads GLB and glTF 2.0 to arrays, as far as photogrammetry and tilesets use it.

Draco, quantised attributes, texture transforms, unlit and PBR base colours are supported. Anything
else raises `MapSourceError` with the extension's name.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import DracoPy
import numpy as np
from numpy.typing import NDArray

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array, matrix_from_quaternion
from localizer.map.importers.gltf_data import (
    GltfData,
    Reader,
    checked_count,
    item,
    normalised,
    normalised_bounds,
    vector,
)
from localizer.map.importers.materials import (
    cut_out,
    decode_alpha,
    decode_image,
    material_of,
    merge_by_image,
    palette_mesh,
    picture_size,
    srgb,
    tinted,
    transform_mesh,
)
from localizer.map.importers.rules import DEFAULT_RULES, ImportRules
from localizer.map.source import SourceMesh
from localizer.types import Image

MAX_NODE_DEPTH = 64

_READABLE = {
    "KHR_draco_mesh_compression",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "EXT_texture_webp",
    "CESIUM_RTC",
    # They change shading only, which a map of baked photographs does not have.
    "KHR_materials_specular",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_ior",
    "KHR_materials_clearcoat",
    "KHR_materials_emissive_strength",
    "KHR_techniques_webgl",
    "EXT_mesh_features",
    "EXT_structural_metadata",
    "EXT_instance_features",
}
_WRAP_REPEAT = 10497
_SURFACES = (4, 5, 6)  # triangles, strips, fans; points and lines have none
_OUTSIDE_UNIT_SQUARE = 0.01  # texture coordinates off by less are rounding, not repetition


# What walking over JSON of the wrong shape raises; everything expected is checked by name.
MALFORMED = (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError)


@contextmanager
def _malformed_named() -> Iterator[None]:
    try:
        yield
    except (*MALFORMED, RecursionError) as error:
        raise MapSourceError(f"malformed glTF: {error!r}") from error


def read_gltf(
    data: bytes, read_uri: Reader, rules: ImportRules = DEFAULT_RULES
) -> tuple[list[SourceMesh], Array]:
    """Meshes of a GLB or glTF document, and its CESIUM_RTC centre (3,), zero when it has none.

    Meshes of one image are merged. Positions are in the document's axes (y up), nodes applied.
    `MapSourceError` if it is malformed.
    """
    with _malformed_named():
        document = _Document(data, read_uri, rules)
        return document.meshes(), document.rtc_center()


def gltf_weight(
    data: bytes, read_uri: Reader, rules: ImportRules = DEFAULT_RULES
) -> tuple[int, int]:
    """Triangles and texels of a document, from its headers alone; see `read_gltf`. `MapSourceError`
    if it is malformed.
    """
    with _malformed_named():
        return _Document(data, read_uri, rules).weight()


def gltf_bounds(
    data: bytes, read_uri: Reader, rules: ImportRules = DEFAULT_RULES
) -> tuple[Array, Array]:
    """Corners (N, 3) of boxes that hold the document's surfaces, from its headers where they state
    them, and its CESIUM_RTC centre (3,); see `read_gltf`. `MapSourceError` if it is malformed.
    """
    with _malformed_named():
        document = _Document(data, read_uri, rules)
        return document.corners(), document.rtc_center()


@dataclass(frozen=True, eq=False)
class _GltfImage:
    """A texture. jpeg: its encoded bytes if it is a JPEG; alpha: (h, w) uint8, None if all is
    opaque; wraps: whether it repeats beyond its edges.
    """

    image: Image
    jpeg: bytes | None
    alpha: NDArray[np.uint8] | None
    wraps: bool


class _GltfImages:
    """A document's textures, each image decoded once."""

    def __init__(self, data: GltfData, rules: ImportRules) -> None:
        self._data, self._json, self._rules = data, data.json, rules
        self._images: dict[int, tuple[Image, bytes | None, NDArray[np.uint8] | None]] = {}

    def of(self, index: int) -> _GltfImage:
        """The texture with this index; `MapSourceError` if it cannot be read."""
        texture = item(self._json.get("textures", []), index, "texture")
        extensions = texture.get("extensions", {})
        if "source" in texture or "EXT_texture_webp" in extensions:
            source = extensions.get("EXT_texture_webp", texture).get(
                "source", texture.get("source")
            )
        elif extensions:
            raise MapSourceError(f"texture needs {', '.join(extensions)}, not supported")
        else:
            raise MapSourceError("a texture has no image")
        sampler = {}
        if "sampler" in texture:
            sampler = item(self._json.get("samplers", []), texture["sampler"], "sampler")
        wraps = sampler.get("wrapS", _WRAP_REPEAT) == _WRAP_REPEAT
        if source not in self._images:
            data = self._data.picture(source)
            self._images[source] = (*decode_image(data, self._rules), decode_alpha(data))
        return _GltfImage(*self._images[source], wraps)


class _Document:
    """The nodes of a document, and the meshes and materials that they show.

    Above 200 lines: nodes, meshes and materials refer to one another by number.
    """

    def __init__(self, data: bytes, read_uri: Reader, rules: ImportRules) -> None:
        self._data = GltfData(data, read_uri)
        self._json = self._data.json
        self._rules = rules
        self._walked: set[int] = set()
        self._vertices = 0
        self._pictures = _GltfImages(self._data, rules)
        unknown = sorted(set(self._json.get("extensionsRequired", [])) - _READABLE)
        if unknown:
            raise MapSourceError(f"needs the glTF extensions {', '.join(unknown)}, not supported")

    def rtc_center(self) -> Array:
        extension = self._json.get("extensions", {}).get("CESIUM_RTC", {})
        return vector(extension.get("center", (0, 0, 0)), 3, "CESIUM_RTC center")

    def meshes(self) -> list[SourceMesh]:
        parts: list[SourceMesh] = []
        for primitive, T in self._placed():
            for part in self._primitive(primitive):
                self._vertices += len(part.positions)
                self._rules.require("vertices", self._vertices, "the glTF")
                parts.append(transform_mesh(part, T))
        return merge_by_image(parts)

    def corners(self) -> Array:
        """(N, 3) of the boxes of all primitives; all vertices where an accessor states no box."""
        found = [np.empty((0, 3))]
        for primitive, T in self._placed():
            index = primitive["attributes"]["POSITION"]
            accessor = item(self._json.get("accessors", []), index, "accessor")
            if "min" in accessor and "max" in accessor:
                low, high = (vector(accessor[name], 3, name) for name in ("min", "max"))
                picks = np.array(list(itertools.product((0, 1), repeat=3)), bool)
                points = normalised_bounds(np.where(picks, high, low), accessor)
            else:
                points = self._geometry(primitive)[0]["POSITION"].astype(np.float64)
            found.append(points @ T[:3, :3].T + T[:3, 3])
        return np.concatenate(found)

    def _placed(self) -> Iterator[tuple[dict[str, Any], Array]]:
        """The primitives of the document's scene, each with its transform (4, 4)."""
        scenes = self._json.get("scenes", [])
        if scenes:
            roots = item(scenes, self._json.get("scene", 0), "scene").get("nodes", [])
        else:
            roots = range(len(self._json.get("nodes", [])))
        self._walked.clear()
        for root in roots:
            yield from self._walk(root, np.eye(4), 0)

    def weight(self) -> tuple[int, int]:
        """Number of triangles (each mesh counted once) and of texels."""
        accessors = self._json.get("accessors", [])
        corners = 0
        for mesh in self._json.get("meshes", []):
            for primitive in mesh.get("primitives", []):
                index = primitive.get("indices", primitive["attributes"]["POSITION"])
                corners += checked_count(item(accessors, index, "accessor"))
        sizes = [
            picture_size(self._data.picture(i))[0] for i in range(len(self._json.get("images", [])))
        ]
        return corners // 3, sum(width * height for width, height in sizes)

    def _walk(
        self, index: int, parent: Array, depth: int
    ) -> Iterator[tuple[dict[str, Any], Array]]:
        if depth > MAX_NODE_DEPTH:
            raise MapSourceError("nodes are nested too deeply or in a cycle")
        if index in self._walked:  # glTF 2.0, 3.5.2: strict trees; others grow without bound
            raise MapSourceError(f"node {index} has several parents, or is in a cycle")
        self._walked.add(index)
        self._rules.require("nodes", len(self._walked), "the glTF")
        node = item(self._json.get("nodes", []), index, "node")
        T = parent @ _node_matrix(node)
        if "mesh" in node and np.linalg.det(T[:3, :3]) < 0:
            self._rules.accept("mirrored", f"node {index} mirrors its mesh: left becomes right")
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise MapSourceError("uses EXT_mesh_gpu_instancing, not supported")
        if "mesh" in node:
            mesh = item(self._json.get("meshes", []), node["mesh"], "mesh")
            for primitive in mesh.get("primitives", []):
                if primitive.get("mode", 4) in _SURFACES:
                    yield primitive, T
        for child in node.get("children", []):
            yield from self._walk(child, T, depth + 1)

    def _primitive(self, primitive: dict[str, Any]) -> list[SourceMesh]:
        mode = primitive.get("mode", 4)
        attributes, faces = self._geometry(primitive)
        positions = attributes["POSITION"].astype(np.float64)
        if positions.shape[1] != 3:
            raise MapSourceError("positions are not of three coordinates")
        if not np.isfinite(positions).all():
            raise MapSourceError("positions are not finite")
        if faces is None:
            faces = np.arange(len(positions))
        if faces.dtype.kind not in "iu":
            raise MapSourceError("indices are not whole numbers")
        triangles = _triangles(faces.astype(np.int64).ravel(), mode)
        if len(triangles) and (triangles.max() >= len(positions) or triangles.min() < 0):
            raise MapSourceError("an index points beyond the vertices")
        if len(triangles) == 0:
            return []
        material = {}
        if "material" in primitive:
            material = item(self._json.get("materials", []), primitive["material"], "material")
        faces32 = triangles.astype(np.int32)
        part = self._textured(positions, faces32, attributes, material)
        return [] if part is None or not len(part.faces) else [part]

    def _geometry(
        self, primitive: dict[str, Any]
    ) -> tuple[dict[str, NDArray[Any]], NDArray[Any] | None]:
        names = primitive.get("attributes", {})
        if "POSITION" not in names:
            raise MapSourceError("a primitive has no POSITION")
        wanted = [n for n in names if n in ("POSITION", "COLOR_0") or n.startswith("TEXCOORD_")]
        extensions = primitive.get("extensions", {})
        draco = extensions.get("KHR_draco_mesh_compression")
        if draco is not None:
            return self._draco(draco, {n: names[n] for n in wanted})
        attributes = {n: self._data.accessor(names[n]) for n in wanted}
        count = len(attributes["POSITION"])
        if any(len(a) != count for a in attributes.values()):
            raise MapSourceError("vertex attributes differ in length")
        faces = self._data.accessor(primitive["indices"]) if "indices" in primitive else None
        return attributes, faces

    def _draco(
        self, draco: dict[str, Any], accessors: dict[str, int]
    ) -> tuple[dict[str, NDArray[Any]], NDArray[Any]]:
        for index in accessors.values():
            checked_count(item(self._json.get("accessors", []), index, "accessor"))
        data = self._data.buffer_view(draco.get("bufferView", -1))[0]
        try:
            mesh = DracoPy.decode(data)
        except Exception as error:  # DracoPy raises its own bare types
            raise MapSourceError(f"Draco data cannot be decoded: {error}") from error
        if not hasattr(mesh, "faces"):
            raise MapSourceError("Draco data holds points, not triangles")
        attributes: dict[str, NDArray[Any]] = {}
        for name, unique_id in draco.get("attributes", {}).items():
            if name not in accessors:
                continue
            found = mesh.get_attribute_by_unique_id(unique_id)
            if found is None:
                raise MapSourceError(f"Draco data lacks attribute {name}")
            accessor = self._json["accessors"][accessors[name]]
            attributes[name] = normalised(np.asarray(found["data"]), accessor)
        if "POSITION" not in attributes:
            raise MapSourceError("Draco data has no positions")
        return attributes, np.asarray(mesh.faces)

    def _textured(
        self,
        positions: Array,
        faces: NDArray[np.int32],
        attributes: dict[str, NDArray[Any]],
        material: dict[str, Any],
    ) -> SourceMesh | None:
        look = material_of(material)
        if look.is_hidden:
            return None
        if look.texture is not None:
            transform = look.texture.get("extensions", {}).get("KHR_texture_transform", {})
            name = f"TEXCOORD_{transform.get('texCoord', look.texture.get('texCoord', 0))}"
            if name in attributes:
                uvs = _transformed_uvs(attributes[name].astype(np.float64), transform)
                picture = self._pictures.of(look.texture.get("index", -1))
                image, jpeg = picture.image, picture.jpeg
                if not np.allclose(look.factor, 1.0, atol=1e-3):
                    image, jpeg = tinted(image, look.factor), None
                low, high = uvs.min(initial=0.0), uvs.max(initial=1.0)
                outside = low < -_OUTSIDE_UNIT_SQUARE or high > 1 + _OUTSIDE_UNIT_SQUARE
                repeat, uvs32 = bool(picture.wraps and outside), uvs.astype(np.float32)
                if look.cutoff is not None and picture.alpha is not None:
                    opaque = picture.alpha * (look.opacity / 255) >= look.cutoff
                    positions, uvs32, faces = cut_out(
                        positions, uvs32, faces, opaque, repeat=repeat
                    )
                return SourceMesh(positions, uvs32, faces, image, jpeg, repeat)
        if "COLOR_0" in attributes:
            colours = attributes["COLOR_0"][:, :3].astype(np.float64)[faces].mean(axis=1)
            linear = colours * look.factor
        else:
            linear = np.broadcast_to(look.factor, (len(faces), 3))
        return palette_mesh(positions, faces, srgb(linear))


def _node_matrix(node: dict[str, Any]) -> Array:
    if "matrix" in node:
        columns: Array = vector(node["matrix"], 16, "node matrix").reshape(4, 4).T
        return columns
    T = np.eye(4)
    rotation = vector(node.get("rotation", (0, 0, 0, 1)), 4, "node rotation")
    if not np.any(rotation):
        raise MapSourceError("a node's rotation is zero")
    scale = vector(node.get("scale", (1, 1, 1)), 3, "node scale")
    T[:3, :3] = matrix_from_quaternion(np.roll(rotation, 1)) * scale
    T[:3, 3] = vector(node.get("translation", (0, 0, 0)), 3, "node translation")
    return T


def _triangles(indices: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    if mode == 4:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return indices[:0].reshape(0, 3)
    if mode == 6:
        first = np.full(len(indices) - 2, indices[0])
        return np.stack([first, indices[1:-1], indices[2:]], axis=-1)
    strip = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=-1)
    strip[1::2] = strip[1::2, ::-1]  # every second triangle winds the other way
    return strip


def _transformed_uvs(uvs: Array, transform: dict[str, Any]) -> Array:
    if not transform:
        return uvs
    offset = vector(transform.get("offset", (0, 0)), 2, "texture offset")
    scale = vector(transform.get("scale", (1, 1)), 2, "texture scale")
    angle = float(transform.get("rotation", 0.0))
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray((uvs * scale) @ np.array([[c, -s], [s, c]]) + offset)
