"""Binary data of a glTF: accessors, buffer views, images, each checked when it is read."""

from __future__ import annotations

import base64
import binascii
import json
import reprlib
import struct
from collections.abc import Callable
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array

MAX_ELEMENTS = 50_000_000  # vertices or indices of one primitive

_COMPONENT = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32}
_COMPONENT_TYPES: dict[int, Any] = {**_COMPONENT, 5126: np.float32}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}

Reader = Callable[[str], bytes]  # resolves a relative URI of the file; raises MapSourceError


class GltfData:
    """A glTF document's JSON and its binary data."""

    def __init__(self, data: bytes, read_uri: Reader) -> None:
        self._read_uri = read_uri
        self.json, self._binary = _split_glb(data)
        self._buffers: dict[int, bytes] = {}

    def picture(self, index: int) -> bytes:
        """Bytes of an encoded image: JPEG, PNG or WebP. `MapSourceError` if there is none."""
        image = item(self.json.get("images", []), index, "image")
        if "bufferView" in image:
            return self.buffer_view(image["bufferView"])[0]
        return self._uri(image.get("uri", ""))

    def accessor(self, index: int) -> NDArray[Any]:
        """An accessor's elements (count, components). `MapSourceError` if it is sparse, of an
        unknown type, or larger than its buffer view.
        """
        accessor = item(self.json.get("accessors", []), index, "accessor")
        if "sparse" in accessor:
            raise MapSourceError("uses sparse accessors, not supported")
        dtype = np.dtype(_COMPONENT_TYPES.get(accessor.get("componentType", -1), np.void))
        width = _WIDTH.get(accessor.get("type", ""), 0)
        if dtype == np.void or not width:
            raise MapSourceError(f"accessor of unknown type {accessor.get('type')!r}")
        count = checked_count(accessor)
        data, view_stride = self.buffer_view(accessor.get("bufferView", -1))
        stride = view_stride or dtype.itemsize * width
        start = whole(accessor.get("byteOffset", 0), "byteOffset")
        end = start + (count - 1) * stride + dtype.itemsize * width
        if stride < dtype.itemsize * width or end > len(data):
            raise MapSourceError(f"accessor of {count} elements is larger than its buffer view")
        array: NDArray[Any] = np.ndarray(
            (count, width), dtype, data, start, (stride, dtype.itemsize)
        )
        return normalised(array, accessor)

    def buffer_view(self, index: int) -> tuple[bytes, int]:
        """A view's bytes and its stride, 0 if it is packed. `MapSourceError` if it is compressed or
        reaches beyond its buffer.
        """
        view = item(self.json.get("bufferViews", []), index, "buffer view")
        if "EXT_meshopt_compression" in view.get("extensions", {}):
            raise MapSourceError("uses EXT_meshopt_compression, not supported")
        data = self._buffer(view.get("buffer", 0))
        start = whole(view.get("byteOffset", 0), "byteOffset")
        end = start + whole(view.get("byteLength", 0), "byteLength")
        if end > len(data):
            raise MapSourceError("a buffer view reaches beyond its buffer; is the file cut off?")
        return data[start:end], whole(view.get("byteStride", 0), "byteStride")

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            buffer = item(self.json.get("buffers", []), index, "buffer")
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


def checked_count(accessor: dict[str, Any]) -> int:
    """Number of elements of an accessor; `MapSourceError` if it is impossible."""
    count = whole(accessor.get("count", 0), "count")
    if not 0 < count <= MAX_ELEMENTS:
        raise MapSourceError(f"an accessor has {count} elements; 1 to {MAX_ELEMENTS} can be")
    return count


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


def normalised(array: NDArray[Any], accessor: dict[str, Any]) -> NDArray[Any]:
    """Normalised integers as floats (KHR_mesh_quantization); everything else as it is."""
    if not accessor.get("normalized") or array.dtype.kind == "f":
        return array
    return np.maximum(array.astype(np.float64) / np.iinfo(array.dtype).max, -1.0)


def normalised_bounds(bounds: Array, accessor: dict[str, Any]) -> Array:
    """An accessor's min and max, normalised as its elements are."""
    dtype = np.dtype(_COMPONENT_TYPES[accessor.get("componentType", 5126)])
    return np.asarray(normalised(bounds.astype(dtype), accessor), np.float64)


def vector(values: Any, length: int, what: str) -> Array:
    """Numbers of the JSON as (length,); `MapSourceError`, which names `what`, for others."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise MapSourceError(f"{what} is not numbers") from error
    if array.shape != (length,) or not np.isfinite(array).all():
        raise MapSourceError(f"{what} is not {length} finite numbers")
    return array


def whole(value: Any, what: str) -> int:
    """A non-negative integer of the JSON; `MapSourceError` for another value."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 63:
        raise MapSourceError(f"{what} is {reprlib.repr(value)}, not a whole number from 0 up")
    return value


def item(items: Any, index: Any, what: str) -> dict[str, Any]:
    """The object at an index of a list of the JSON; `MapSourceError` if there is none."""
    if (
        not isinstance(items, list)
        or not isinstance(index, int)
        or not 0 <= index < len(items)
        or not isinstance(items[index], dict)
    ):
        raise MapSourceError(f"there is no {what} {index!r}")
    found: dict[str, Any] = items[index]
    return found
