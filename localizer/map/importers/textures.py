"""Textures of sources: decoding with limits, flat colours, merging of meshes by image."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.importers.rules import ImportRules
from localizer.map.source import SourceMesh
from localizer.types import Image

_BLOCK = 4  # texels per colour of a palette, so that bilinear look-up at its centre mixes nothing


def picture_size(data: bytes) -> tuple[tuple[int, int], str | None]:
    """(width, height) and format (None: unknown) of an image, from its header. `MapSourceError` if
    it cannot be read.
    """
    try:
        with PillowImage.open(io.BytesIO(data)) as header:
            return header.size, header.format
    except (OSError, ValueError, SyntaxError, PillowImage.DecompressionBombError) as error:
        raise MapSourceError(f"a texture is not a picture that can be read: {error}") from error


def require_readable(path: Path, rules: ImportRules) -> None:
    """`MapSourceError` for an image too large or not decodable: trimesh would show it grey."""
    try:
        with PillowImage.open(path) as picture:
            width, height = picture.size
            rules.require("texels", float(width) * height, path)
            picture.load()
    except (OSError, ValueError, SyntaxError, PillowImage.DecompressionBombError) as error:
        raise MapSourceError(f"{path}: a texture that cannot be read: {error}") from error


def decode_image(data: bytes, rules: ImportRules) -> tuple[Image, bytes | None]:
    """RGB image (h, w, 3) of JPEG, PNG or WebP bytes, and the bytes again if they are JPEG, else
    None. `MapSourceError` if it cannot be decoded.
    """
    (width, height), kind = picture_size(data)
    rules.require("texels", float(width) * height, f"a texture of {width}x{height}")
    image = cv2.imdecode(
        np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    )
    if image is None:
        raise MapSourceError(f"a {kind} texture cannot be decoded")
    rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    return rgb, data if kind == "JPEG" else None


def decode_alpha(data: bytes) -> NDArray[np.uint8] | None:
    """Alpha (h, w) of an image that `decode_image` could read; None if it is opaque."""
    with PillowImage.open(io.BytesIO(data)) as picture:
        if not picture.has_transparency_data:
            return None
        alpha = np.asarray(picture.convert("RGBA").getchannel("A"), np.uint8)
    return None if alpha.min() == 255 else alpha


def palette_mesh(positions: Array, faces: NDArray[np.int32], colours: Image) -> SourceMesh:
    """A mesh of flat-coloured faces. colours: (F, 3) uint8, stored as blocks of a texture; of more
    than 65,536 different ones the lower 3 bits are dropped.
    """
    unique, which = np.unique(colours.reshape(-1, 3), axis=0, return_inverse=True)
    if len(unique) > 65536:
        unique, which = np.unique(colours & 0xF8, axis=0, return_inverse=True)
    columns = int(np.ceil(np.sqrt(len(unique))))
    rows = -(-len(unique) // columns)
    grid = np.zeros((rows * columns, 3), np.uint8)
    grid[: len(unique)] = unique
    image = grid.reshape(rows, columns, 3).repeat(_BLOCK, axis=0).repeat(_BLOCK, axis=1)
    which = which.ravel()
    centre = np.stack([which % columns + 0.5, which // columns + 0.5], axis=-1)
    uvs = (centre / (columns, rows)).astype(np.float32).repeat(3, axis=0)
    apart = np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3)
    return SourceMesh(positions[faces.ravel()], uvs, apart, image, palette=True)


def transform_mesh(mesh: SourceMesh, T: Array) -> SourceMesh:
    """The mesh after a transform (4, 4). A mirroring transform also reverses the corner order,
    which keeps the front side (glTF 2.0, 3.7.4).
    """
    made = replace(mesh, positions=mesh.positions @ T[:3, :3].T + T[:3, 3])
    if np.linalg.det(T[:3, :3]) < 0:
        made = replace(made, faces=np.ascontiguousarray(mesh.faces[:, ::-1]))
    return made


def merge_by_image(parts: list[SourceMesh]) -> list[SourceMesh]:
    """Merge meshes with the same texture image and wrapping; all flat-coloured meshes become one
    mesh with a palette.
    """
    groups: dict[tuple[int, bool], list[SourceMesh]] = {}
    palettes = [p for p in parts if p.palette]
    for part in parts:
        if not part.palette:
            groups.setdefault((id(part.image), part.repeat), []).append(part)
    merged = [_concatenated(group) for group in groups.values()]
    if palettes:
        positions = np.concatenate([p.positions for p in palettes])
        colours = np.concatenate([_face_colours(p) for p in palettes])
        faces = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
        merged.append(palette_mesh(positions, faces, colours))
    return merged


def _face_colours(part: SourceMesh) -> Image:
    h, w = part.image.shape[:2]
    first = part.uvs[part.faces[:, 0]] * (w, h)
    x, y = first.astype(np.int64).T
    colours: Image = part.image[y, x]
    return colours


def _concatenated(group: list[SourceMesh]) -> SourceMesh:
    if len(group) == 1:
        return group[0]
    starts = np.cumsum([0, *(len(p.positions) for p in group)])
    return SourceMesh(
        np.concatenate([p.positions for p in group]),
        np.concatenate([p.uvs for p in group]),
        np.concatenate(
            [p.faces + np.int32(s) for p, s in zip(group, starts[:-1], strict=True)]
        ).astype(np.int32),
        group[0].image,
        group[0].jpeg,
        group[0].repeat,
    )


def srgb(linear: Array) -> Image:
    """8-bit sRGB of linear light from 0 to 1."""
    x = np.clip(linear, 0.0, 1.0)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    pixels: Image = np.rint(255 * encoded).astype(np.uint8)
    return pixels


def tinted(image: Image, factor: Array) -> Image:
    """An sRGB image multiplied by linear factors (3,)."""
    levels = np.arange(256) / 255
    linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    table = srgb(linear[:, None] * factor)
    return np.stack([table[image[..., c], c] for c in range(3)], axis=-1)
