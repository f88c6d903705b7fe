"""GLB and glTF to plain arrays: what photogrammetry and tilesets use of glTF 2.0.

Draco, quantised attributes, texture transforms, unlit and PBR base colours are read. Anything that
this module cannot decode raises `MapSourceError` with the extension's name.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Callable
from typing import Any
from urllib.parse import unquote

import DracoPy
import numpy as np
from numpy.typing import NDArray

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array, matrix_from_quaternion
from localizer.map.importers.rules import ImportRules
from localizer.map.importers.textures import (
    decode_image,
    merged_by_picture,
    palette_mesh,
    picture_size,
    srgb,
    tinted,
)
from localizer.map.source import SourceMesh
from localizer.types import Image

MAX_ELEMENTS = 50_000_000  # vertices or indices of one primitive
MAX_NODE_DEPTH = 64

_COMPONENT = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32}
_COMPONENT_TYPES: dict[int, Any] = {**_COMPONENT, 5126: np.float32}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
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
_OUTSIDE_UNIT_SQUARE = 0.01  # texture coordinates off by less are rounding, not repetition


# What walking over JSON of the wrong shape raises; everything expected is checked by name.
_MALFORMED = (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError)

Reader = Callable[[str], bytes]  # resolves a relative URI of the file; raises MapSourceError


def read_gltf(
    data: bytes, read_uri: Reader, rules: ImportRules | None = None
) -> tuple[list[SourceMesh], Array]:
    """Meshes of a GLB or glTF document, and its CESIUM_RTC centre (3,), zero when it has none.

    Meshes of one image are merged. Positions are in the document's axes (y up), nodes applied.
    """
    try:
        document = _Document(data, read_uri, rules or ImportRules())
        return document.meshes(), document.rtc_center()
    except (*_MALFORMED, RecursionError) as error:
        raise MapSourceError(f"malformed glTF: {error!r}") from error


def gltf_weight(data: bytes, read_uri: Reader, rules: ImportRules | None = None) -> tuple[int, int]:
    """Triangles and texels of a document, from its headers alone; see `read_gltf`."""
    try:
        return _Document(data, read_uri, rules or ImportRules()).weight()
    except _MALFORMED as error:
        raise MapSourceError(f"malformed glTF: {error!r}") from error


class _Document:
    def __init__(self, data: bytes, read_uri: Reader, rules: ImportRules) -> None:
        self._read_uri = read_uri
        self._rules = rules
        self._walked: set[int] = set()
        self._vertices = 0
        self._json, self._binary = _split_glb(data)
        self._buffers: dict[int, bytes] = {}
        self._images: dict[int, tuple[Image, bytes | None]] = {}
        unknown = sorted(set(self._json.get("extensionsRequired", [])) - _READABLE)
        if unknown:
            raise MapSourceError(f"needs the glTF extensions {', '.join(unknown)}, not supported")

    def rtc_center(self) -> Array:
        extension = self._json.get("extensions", {}).get("CESIUM_RTC", {})
        return _vector(extension.get("center", (0, 0, 0)), 3, "CESIUM_RTC center")

    def meshes(self) -> list[SourceMesh]:
        scenes = self._json.get("scenes", [])
        if scenes:
            roots = _item(scenes, self._json.get("scene", 0), "scene").get("nodes", [])
        else:
            roots = range(len(self._json.get("nodes", [])))
        parts: list[SourceMesh] = []
        for root in roots:
            self._walk(root, np.eye(4), 0, parts)
        return merged_by_picture(parts)

    def weight(self) -> tuple[int, int]:
        """Triangles (as if each mesh were used once) and texels."""
        accessors = self._json.get("accessors", [])
        corners = 0
        for mesh in self._json.get("meshes", []):
            for primitive in mesh.get("primitives", []):
                index = primitive.get("indices", primitive["attributes"]["POSITION"])
                corners += self._checked_count(_item(accessors, index, "accessor"))
        sizes = [
            picture_size(self._picture(i))[0] for i in range(len(self._json.get("images", [])))
        ]
        return corners // 3, sum(width * height for width, height in sizes)

    def _walk(self, index: int, parent: Array, depth: int, parts: list[SourceMesh]) -> None:
        if depth > MAX_NODE_DEPTH:
            raise MapSourceError("nodes are nested too deeply or in a cycle")
        if index in self._walked:  # glTF 2.0, 3.5.2: strict trees; others grow without bound
            raise MapSourceError(f"node {index} has several parents, or is in a cycle")
        self._walked.add(index)
        self._rules.require("nodes", len(self._walked), "the glTF")
        node = _item(self._json.get("nodes", []), index, "node")
        T = parent @ _node_matrix(node)
        if "mesh" in node and np.linalg.det(T[:3, :3]) < 0:
            self._rules.doubt("mirrored", f"node {index} mirrors its mesh: left becomes right")
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise MapSourceError("uses EXT_mesh_gpu_instancing, not supported")
        if "mesh" in node:
            mesh = _item(self._json.get("meshes", []), node["mesh"], "mesh")
            for primitive in mesh.get("primitives", []):
                part = self._primitive(primitive)
                if part is not None:
                    self._vertices += len(part.positions)
                    self._rules.require("vertices", self._vertices, "the glTF")
                    positions = part.positions @ T[:3, :3].T + T[:3, 3]
                    parts.append(_with_positions(part, positions))
        for child in node.get("children", []):
            self._walk(child, T, depth + 1, parts)

    def _primitive(self, primitive: dict[str, Any]) -> SourceMesh | None:
        mode = primitive.get("mode", 4)
        if mode not in (4, 5, 6):
            return None  # points and lines have no surface
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
            return None
        material = {}
        if "material" in primitive:
            material = _item(self._json.get("materials", []), primitive["material"], "material")
        faces32 = triangles.astype(np.int32)
        return self._textured(positions, faces32, attributes, material)

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
        attributes = {n: self._accessor(names[n]) for n in wanted}
        count = len(attributes["POSITION"])
        if any(len(a) != count for a in attributes.values()):
            raise MapSourceError("vertex attributes differ in length")
        faces = self._accessor(primitive["indices"]) if "indices" in primitive else None
        return attributes, faces

    def _draco(
        self, draco: dict[str, Any], accessors: dict[str, int]
    ) -> tuple[dict[str, NDArray[Any]], NDArray[Any]]:
        for index in accessors.values():
            self._checked_count(_item(self._json.get("accessors", []), index, "accessor"))
        data = self._buffer_view(draco.get("bufferView", -1))[0]
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
            attributes[name] = _normalised(np.asarray(found["data"]), accessor)
        if "POSITION" not in attributes:
            raise MapSourceError("Draco data has no positions")
        return attributes, np.asarray(mesh.faces)

    def _textured(
        self,
        positions: Array,
        faces: NDArray[np.int32],
        attributes: dict[str, NDArray[Any]],
        material: dict[str, Any],
    ) -> SourceMesh:
        pbr = material.get("pbrMetallicRoughness", {})
        factor = _vector(pbr.get("baseColorFactor", (1, 1, 1, 1)), 4, "baseColorFactor")[:3]
        texture = pbr.get("baseColorTexture")
        gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
        texture = texture or gloss.get("diffuseTexture") or material.get("emissiveTexture")
        if texture is not None:
            transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
            name = f"TEXCOORD_{transform.get('texCoord', texture.get('texCoord', 0))}"
            if name in attributes:
                uvs = _transformed_uvs(attributes[name].astype(np.float64), transform)
                image, jpeg, wraps = self._texture(texture.get("index", -1))
                if not np.allclose(factor, 1.0, atol=1e-3):
                    image, jpeg = tinted(image, factor), None
                low, high = uvs.min(initial=0.0), uvs.max(initial=1.0)
                outside = low < -_OUTSIDE_UNIT_SQUARE or high > 1 + _OUTSIDE_UNIT_SQUARE
                return SourceMesh(
                    positions, uvs.astype(np.float32), faces, image, jpeg, wraps and outside
                )
        if "COLOR_0" in attributes:
            linear = attributes["COLOR_0"][:, :3].astype(np.float64)[faces].mean(axis=1) * factor
        else:
            linear = np.broadcast_to(factor, (len(faces), 3))
        return palette_mesh(positions, faces, srgb(linear))

    def _texture(self, index: int) -> tuple[Image, bytes | None, bool]:
        texture = _item(self._json.get("textures", []), index, "texture")
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
            sampler = _item(self._json.get("samplers", []), texture["sampler"], "sampler")
        wraps = sampler.get("wrapS", _WRAP_REPEAT) == _WRAP_REPEAT
        if source not in self._images:
            self._images[source] = decode_image(self._picture(source), self._rules)
        return (*self._images[source], wraps)

    def _picture(self, index: int) -> bytes:
        image = _item(self._json.get("images", []), index, "image")
        if "bufferView" in image:
            return self._buffer_view(image["bufferView"])[0]
        return self._uri(image.get("uri", ""))

    def _accessor(self, index: int) -> NDArray[Any]:
        accessor = _item(self._json.get("accessors", []), index, "accessor")
        if "sparse" in accessor:
            raise MapSourceError("uses sparse accessors, not supported")
        dtype = np.dtype(_COMPONENT_TYPES.get(accessor.get("componentType", -1), np.void))
        width = _WIDTH.get(accessor.get("type", ""), 0)
        if dtype == np.void or not width:
            raise MapSourceError(f"accessor of unknown type {accessor.get('type')!r}")
        count = self._checked_count(accessor)
        data, view_stride = self._buffer_view(accessor.get("bufferView", -1))
        stride = view_stride or dtype.itemsize * width
        start = _whole(accessor.get("byteOffset", 0), "byteOffset")
        end = start + (count - 1) * stride + dtype.itemsize * width
        if stride < dtype.itemsize * width or end > len(data):
            raise MapSourceError(f"accessor of {count} elements is larger than its buffer view")
        array: NDArray[Any] = np.ndarray(
            (count, width), dtype, data, start, (stride, dtype.itemsize)
        )
        return _normalised(array, accessor)

    @staticmethod
    def _checked_count(accessor: dict[str, Any]) -> int:
        count = _whole(accessor.get("count", 0), "count")
        if not 0 < count <= MAX_ELEMENTS:
            raise MapSourceError(f"an accessor has {count} elements; 1 to {MAX_ELEMENTS} can be")
        return count

    def _buffer_view(self, index: int) -> tuple[bytes, int]:
        view = _item(self._json.get("bufferViews", []), index, "buffer view")
        if "EXT_meshopt_compression" in view.get("extensions", {}):
            raise MapSourceError("uses EXT_meshopt_compression, not supported")
        data = self._buffer(view.get("buffer", 0))
        start = _whole(view.get("byteOffset", 0), "byteOffset")
        end = start + _whole(view.get("byteLength", 0), "byteLength")
        if end > len(data):
            raise MapSourceError("a buffer view reaches beyond its buffer; is the file cut off?")
        return data[start:end], _whole(view.get("byteStride", 0), "byteStride")

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            buffer = _item(self._json.get("buffers", []), index, "buffer")
            uri = buffer.get("uri")
            if uri is None and (index != 0 or self._binary is None):
                raise MapSourceError("a buffer has no data")
            self._buffers[index] = self._binary or b"" if uri is None else self._uri(uri)
        return self._buffers[index]

    def _uri(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except binascii.Error as error:
                raise MapSourceError(f"a data URI is not base64: {error}") from error
        return self._read_uri(unquote(uri))


def _split_glb(data: bytes) -> tuple[dict[str, Any], bytes | None]:
    binary: bytes | None = None
    text = data
    if data[:4] == b"glTF":
        if len(data) < 20:
            raise MapSourceError("GLB is cut off in its header")
        version, length = struct.unpack_from("<II", data, 4)
        if version != 2:
            raise MapSourceError(f"glTF version {version} is not supported, 2 is")
        if length > len(data):
            raise MapSourceError(f"GLB is cut off: {len(data)} of {length} bytes")
        chunks = _glb_chunks(data[:length])
        text = chunks.get(b"JSON", b"")
        binary = chunks.get(b"BIN\0")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MapSourceError(f"glTF JSON cannot be read: {error}") from error
    if not isinstance(document, dict):
        raise MapSourceError("glTF JSON is not an object")
    return document, binary


def _glb_chunks(data: bytes) -> dict[bytes, bytes]:
    chunks: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + length > len(data):
            raise MapSourceError("a GLB chunk is cut off")
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length + (-length) % 4
    return chunks


def _with_positions(part: SourceMesh, positions: Array) -> SourceMesh:
    return SourceMesh(
        positions, part.uvs, part.faces, part.image, part.jpeg, part.repeat, part.palette
    )


def _node_matrix(node: dict[str, Any]) -> Array:
    if "matrix" in node:
        columns: Array = _vector(node["matrix"], 16, "node matrix").reshape(4, 4).T
        return columns
    T = np.eye(4)
    rotation = _vector(node.get("rotation", (0, 0, 0, 1)), 4, "node rotation")
    if not np.any(rotation):
        raise MapSourceError("a node's rotation is zero")
    scale = _vector(node.get("scale", (1, 1, 1)), 3, "node scale")
    T[:3, :3] = matrix_from_quaternion(np.roll(rotation, 1)) * scale
    T[:3, 3] = _vector(node.get("translation", (0, 0, 0)), 3, "node translation")
    return T


def _triangles(indices: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    if mode == 4:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return indices[:0].reshape(0, 3)
    if mode == 6:
        first = np.full(len(indices) - 2, indices[0])
        return np.stack([first, indices[1:-1], indices[2:]], axis=-1)
    return np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=-1)


def _normalised(array: NDArray[Any], accessor: dict[str, Any]) -> NDArray[Any]:
    """Normalised integers as floats (KHR_mesh_quantization); everything else as it is."""
    if not accessor.get("normalized") or array.dtype.kind == "f":
        return array
    return np.maximum(array.astype(np.float64) / np.iinfo(array.dtype).max, -1.0)


def _transformed_uvs(uvs: Array, transform: dict[str, Any]) -> Array:
    if not transform:
        return uvs
    offset = _vector(transform.get("offset", (0, 0)), 2, "texture offset")
    scale = _vector(transform.get("scale", (1, 1)), 2, "texture scale")
    angle = float(transform.get("rotation", 0.0))
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray((uvs * scale) @ np.array([[c, -s], [s, c]]) + offset)


def _vector(values: Any, length: int, what: str) -> Array:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise MapSourceError(f"{what} is not numbers") from error
    if array.shape != (length,) or not np.isfinite(array).all():
        raise MapSourceError(f"{what} is not {length} finite numbers")
    return array


def _whole(value: Any, what: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise MapSourceError(f"{what} is {value!r}, not a whole number from 0 up")
    return value


def _item(items: Any, index: Any, what: str) -> dict[str, Any]:
    if (
        not isinstance(items, list)
        or not isinstance(index, int)
        or not 0 <= index < len(items)
        or not isinstance(items[index], dict)
    ):
        raise MapSourceError(f"there is no {what} {index!r}")
    found: dict[str, Any] = items[index]
    return found
