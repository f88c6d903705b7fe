"""Writing 3D Tiles 1.1: binary glTF content and an explicit tileset.json.

References: OGC 22-025r4 (3D Tiles 1.1), Khronos glTF 2.0 with KHR_materials_unlit.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array, Pose
from localizer.types import Image

JPEG_QUALITY = 86
_FLOAT, _UINT32 = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP = 9729, 9987, 33071


@dataclass
class TileNode:
    """A tile: content file, origin (3,) ENU of its own frame, ENU bounds of itself and below."""

    uri: str
    origin: Array
    low: Array
    high: Array
    geometric_error_m: float
    children: list[TileNode] = field(default_factory=list)

    def enclose(self) -> None:
        """Grow the bounds so that they hold those of all descendants."""
        for child in self.children:
            child.enclose()
            self.low = np.minimum(self.low, child.low)
            self.high = np.maximum(self.high, child.high)


def encode_jpeg(image: Image) -> bytes:
    """JPEG bytes of an RGB image. `MapSourceError` if it cannot be encoded."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not ok:
        raise MapSourceError(f"a texture of {image.shape[1]}x{image.shape[0]} cannot be encoded")
    return data.tobytes()


def glb_bytes(
    positions: NDArray[np.float32], uvs: NDArray[np.float32], faces: NDArray[np.int64], image: Image
) -> bytes:
    """Binary glTF of one textured, unlit mesh.

    positions: (V, 3) in the tile's east-north-up frame; glTF is y-up, and 3D Tiles turns it back
    by +90 degrees about x: (e, n, u) is stored as (e, u, -n).
    """
    y_up = np.stack([positions[:, 0], positions[:, 2], -positions[:, 1]], -1).astype("<f4")
    chunks = [
        y_up.tobytes(),
        uvs.astype("<f4").tobytes(),
        faces.astype("<u4").reshape(-1).tobytes(),
        encode_jpeg(image),
    ]
    views, binary = [], b""
    for chunk, target in zip(
        chunks, (_ARRAY_BUFFER, _ARRAY_BUFFER, _ELEMENT_BUFFER, None), strict=True
    ):
        binary += b"\0" * (-len(binary) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(chunk)}
        if target is not None:
            view["target"] = target
        views.append(view)
        binary += chunk
    binary += b"\0" * (-len(binary) % 4)
    text = json.dumps(_document(y_up, faces, views, len(binary)), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, total),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(binary), b"BIN\0"),
            binary,
        ]
    )


def _document(
    y_up: NDArray[np.float32],
    faces: NDArray[np.int64],
    views: list[dict[str, Any]],
    binary_length: int,
) -> dict[str, Any]:
    """The JSON of `glb_bytes`: buffer views 0 to 3 are positions, texture coordinates, indices and
    the image.
    """
    count = len(y_up)
    return {
        "asset": {"version": "2.0", "generator": "pilot-companion synth"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "TEXCOORD_0": 1},
                        "indices": 2,
                        "material": 0,
                        "mode": 4,
                    }
                ]
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [
            {
                "magFilter": _LINEAR,
                "minFilter": _LINEAR_MIPMAP_LINEAR,
                "wrapS": _CLAMP,
                "wrapT": _CLAMP,
            }
        ],
        "images": [{"bufferView": 3, "mimeType": "image/jpeg"}],
        "buffers": [{"byteLength": binary_length}],
        "bufferViews": views,
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": count,
                "type": "VEC3",
                "min": [float(v) for v in y_up.min(0)],
                "max": [float(v) for v in y_up.max(0)],
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": count, "type": "VEC2"},
            {
                "bufferView": 2,
                "componentType": _UINT32,
                "count": int(faces.size),
                "type": "SCALAR",
            },
        ],
    }


def write_tileset(path: Path, root: TileNode, ecef_from_enu: Pose, extras: dict[str, Any]) -> None:
    """Write tileset.json with explicit tiles (refinement REPLACE) below `root`, whose bounds are
    computed first. ecef_from_enu: places the world on Earth; extras: stored under "asset".
    """
    root.enclose()
    tile = _tile_json(root, np.zeros(3))
    shift = Pose(np.eye(3), root.origin)
    tile["transform"] = _column_major((ecef_from_enu @ shift).matrix)
    document = {
        "asset": {"version": "1.1", "extras": extras},
        "geometricError": float(np.linalg.norm(root.high - root.low)),
        "root": tile,
    }
    path.write_text(json.dumps(document, separators=(",", ":")))


def _column_major(matrix: Array) -> list[float]:
    return [float(v) for v in matrix.T.reshape(-1)]


def _tile_json(node: TileNode, parent_origin: Array) -> dict[str, Any]:
    low, high = node.low - node.origin, node.high - node.origin
    half = (high - low) / 2
    box = [*((low + high) / 2), half[0], 0, 0, 0, half[1], 0, 0, 0, half[2]]
    tile: dict[str, Any] = {
        "boundingVolume": {"box": [float(v) for v in box]},
        "geometricError": float(node.geometric_error_m),
        "refine": "REPLACE",
        "transform": _column_major(Pose(np.eye(3), node.origin - parent_origin).matrix),
        "content": {"uri": node.uri},
    }
    if node.children:
        tile["children"] = [_tile_json(child, node.origin) for child in node.children]
    return tile
