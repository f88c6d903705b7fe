"""Appearance of a material as common viewers draw it: colour, texture (decoded with limits)."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from localizer.errors import MapSourceError
from localizer.geometry.pose import Array
from localizer.map.importers.gltf_data import vector
from localizer.map.importers.referenced_files import file_of
from localizer.map.importers.rules import ImportRules
from localizer.map.source import SourceMesh
from localizer.plain_files import decode_lenient
from localizer.types import Float32, Image

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


_BLACK = 1 / 255  # linear light; a base so dark shows nothing of its own
_LEAST_TEXELS = 4.0  # side of a triangle's part that is not cut further
_MOST_CUTS = 10  # halvings of a triangle
_MOST_FACES = 40_000  # more are not made of one mesh, beyond four times its own
# MTL: statements of a picture, the better ones last; options, with how many values they have.
_PICTURES = {"map_ke": 1, "map_ka": 2, "map_kd": 3}
_OPTIONS = {
    "-o": 3, "-s": 3, "-t": 3, "-mm": 2, "-blendu": 1, "-blendv": 1, "-boost": 1, "-texres": 1,
    "-clamp": 1, "-bm": 1, "-imfchan": 1, "-type": 1, "-cc": 1,
}  # fmt: skip
_CENTRE = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6.0  # barycentric samples


@dataclass(frozen=True, eq=False)
class GltfMaterial:
    """A glTF material. factor: (3,) linear, multiplied with the image or alone; texture: its
    textureInfo; opacity: times the image's alpha; cutoff: transparent below it, None if opaque.
    """

    factor: Array
    texture: dict[str, Any] | None
    opacity: float = 1.0
    cutoff: float | None = None

    @property
    def is_hidden(self) -> bool:
        """Whether it is completely transparent."""
        return self.cutoff is not None and self.opacity < self.cutoff


def material_of(material: dict[str, Any]) -> GltfMaterial:
    """Parse a glTF material (its JSON object). `MapSourceError`: colours of a wrong count; other
    malformed values raise one of `gltf.MALFORMED`.

    Specular-glossiness is preferred to the metallic fallback if it has a texture, or if the
    fallback has none. A base colour that is black or has no texture is replaced by the emission:
    unlit photographs were stored so before KHR_materials_unlit.
    """
    extensions = material.get("extensions", {})
    pbr = material.get("pbrMetallicRoughness", {})
    texture, rgba = pbr.get("baseColorTexture"), pbr.get("baseColorFactor", (1, 1, 1, 1))
    gloss = extensions.get("KHR_materials_pbrSpecularGlossiness")
    if gloss is not None and (texture is None or "diffuseTexture" in gloss):
        texture, rgba = gloss.get("diffuseTexture"), gloss.get("diffuseFactor", (1, 1, 1, 1))
    colour = vector(rgba, 4, "a material's colour factor")
    factor, opacity = colour[:3], float(colour[3])
    strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    emission = vector(material.get("emissiveFactor", (0, 0, 0)), 3, "emissiveFactor")
    emission = np.clip(emission * float(strength), 0.0, 1.0)
    light, is_dark = material.get("emissiveTexture"), bool(factor.max() <= _BLACK)
    if light is not None and (texture is None or is_dark):
        texture, factor = light, emission if emission.any() else np.ones(3)
    elif is_dark and emission.any():
        texture, factor = None, emission
    mode = material.get("alphaMode", "OPAQUE")
    cutoff = {"MASK": float(material.get("alphaCutoff", 0.5)), "BLEND": 0.5}.get(mode)
    return GltfMaterial(factor, texture, opacity, cutoff)


def cut_out(
    positions: Array,
    uvs: Float32,
    faces: NDArray[np.int32],
    opaque: NDArray[np.bool_],
    *,
    repeat: bool,
) -> tuple[Array, Float32, NDArray[np.int32]]:
    """A mesh without its transparent parts. opaque: (h, w) mask of texels; repeat: whether the
    texture wraps. Triangles across a border are cut, accurate to some texels.
    """
    h, w = opaque.shape
    table = np.zeros((h + 1, w + 1), np.int64)
    table[1:, 1:] = opaque.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
    kept: list[NDArray[np.int32]] = []
    most = 4 * len(faces) + _MOST_FACES
    for _ in range(_MOST_CUTS):
        corners = uvs[faces].astype(np.float64) * (w, h)
        if repeat:
            corners -= np.floor(corners.min(axis=1, keepdims=True) / (w, h)) * (w, h)
        low = np.floor(corners.min(axis=1)).astype(np.int64).clip(0, (w - 1, h - 1))
        high = np.ceil(corners.max(axis=1)).astype(np.int64).clip(low + 1, (w, h))
        (x0, y0), (x1, y1) = low.T, high.T
        there = table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0]
        whole, none = there == (x1 - x0) * (y1 - y0), there == 0
        kept.append(faces[whole])
        small = (high - low).max(axis=1) <= _LEAST_TEXELS
        mixed = ~whole & ~none
        count = sum(map(len, kept)) + 4 * int((mixed & ~small).sum())
        done = mixed & small if count <= most else mixed
        kept.append(faces[done][_mostly(corners[done], opaque)])
        faces = faces[mixed & ~done]
        if not len(faces):
            break
        positions, uvs, faces = _halved(positions, uvs, faces)
    else:
        kept.append(faces[_mostly(uvs[faces].astype(np.float64) * (w, h), opaque)])
    return positions, uvs, np.concatenate(kept).astype(np.int32)


def _mostly(corners: Array, opaque: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (F,) of the triangles (F, 3, 2), in texels, of which at least half is opaque."""
    h, w = opaque.shape
    x, y = np.moveaxis(np.einsum("sk,fkc->fsc", _CENTRE, corners), -1, 0).astype(np.int64)
    return np.asarray(opaque[y % h, x % w].mean(axis=1) >= 0.5)


def _halved(
    positions: Array, uvs: Float32, faces: NDArray[np.int32]
) -> tuple[Array, Float32, NDArray[np.int32]]:
    """The mesh with each triangle divided into four, which share no vertices."""
    count = len(faces)
    pairs = ((0, 1), (1, 2), (2, 0))
    middles = [0.5 * (positions[faces[:, a]] + positions[faces[:, b]]) for a, b in pairs]
    uv_middles = [0.5 * (uvs[faces[:, a]] + uvs[faces[:, b]]) for a, b in pairs]
    ab, bc, ca = (len(positions) + k * count + np.arange(count) for k in range(3))
    a, b, c = faces.T
    made = np.concatenate(
        [np.stack(f, axis=1) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    return (
        np.concatenate([positions, *middles]),
        np.concatenate([uvs, *uv_middles]).astype(np.float32),
        made.astype(np.int32),
    )


@dataclass(frozen=True)
class MtlMaterial:
    """A material of an OBJ's library. colour: (3,) from 0 to 1; picture, mask: its texture and
    opacity files; missing: names of missing files; scale, offset: of its texture coordinates;
    clamped: the texture does not wrap.
    """

    name: str
    colour: tuple[float, float, float] = (0.8, 0.8, 0.8)
    picture: Path | None = None
    mask: Path | None = None
    missing: tuple[str, ...] = ()
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamped: bool = False


def read_mtl(library: Path, obj_folder: Path) -> list[MtlMaterial]:
    """The materials of a library in order. Textures are looked for beside it, then in the OBJ's
    folder. The ambient or emissive texture replaces a missing diffuse one.
    """
    made: list[MtlMaterial] = []
    rank = 0
    for line in decode_lenient(library.read_bytes()).splitlines():
        key, rest = ([*line.split(maxsplit=1), "", ""])[:2]
        key, rest = key.lower(), rest.strip()
        if key == "newmtl":
            made.append(MtlMaterial(rest))
            rank = 0
        elif not made or not rest:
            continue
        elif key == "kd" and (colour := _floats(rest.split()[:3])) and len(colour) == 3:
            made[-1] = replace(made[-1], colour=(colour[0], colour[1], colour[2]))
        elif key in _PICTURES and _PICTURES[key] > rank:
            made[-1], rank = _with_picture(made[-1], rest, library, obj_folder), _PICTURES[key]
        elif key == "map_d":
            made[-1] = replace(made[-1], mask=_picture(rest, library, obj_folder)[0])
    return made


def _with_picture(material: MtlMaterial, text: str, library: Path, obj_folder: Path) -> MtlMaterial:
    options, _ = _options(text)
    picture, name = _picture(text, library, obj_folder)
    return replace(
        material,
        picture=picture,
        missing=(name,) if picture is None else (),
        scale=_pair(options.get("-s", []), 1.0),
        offset=_pair(options.get("-o", []), 0.0),
        clamped=options.get("-clamp") == ["on"],
    )


def _picture(text: str, library: Path, obj_folder: Path) -> tuple[Path | None, str]:
    """File and name of a texture statement. The name is the whole text, the text after its options,
    or its last word; the file is None if none of them exists.
    """
    _, name = _options(text)
    for candidate in (text, name, text.rsplit(maxsplit=1)[-1]):
        plain = candidate.strip("\"'")
        for folder in (library.parent, obj_folder):
            if (path := file_of(folder, plain)).is_file():
                return path, plain
    return None, name


def _options(text: str) -> tuple[dict[str, list[str]], str]:
    """Options of a texture statement, and the text after them."""
    words, found = text.split(), dict[str, list[str]]()
    while words and words[0].lower() in _OPTIONS:
        name, most = words[0].lower(), _OPTIONS[words[0].lower()]
        count = 1
        if most > 1:  # as many as are numbers
            count = next((k for k in range(most) if not _floats(words[1 + k : 2 + k])), most)
        found[name] = words[1 : 1 + count]
        words = words[1 + count :]
    return found, " ".join(words)


def _pair(words: list[str], default: float) -> tuple[float, float]:
    """The first two numbers of an option; omitted ones are `default`."""
    u, v, *_ = [*_floats(words), default, default]
    return u, v


def _floats(words: list[str]) -> list[float]:
    """The words as numbers; empty if one of them is no number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []
