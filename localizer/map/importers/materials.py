"""What a material shows, as the common viewers draw it: its colour, its picture, and its holes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.map.importers.gltf_data import vector
from localizer.types import Float32

_BLACK = 1 / 255  # linear light; a base so dark shows nothing of its own
_LEAST_TEXELS = 4.0  # side of a triangle's part that is not cut further
_MOST_CUTS = 10  # halvings of a triangle
_MOST_FACES = 40_000  # more are not made of one mesh, beyond four times its own
_CENTRE = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6.0  # barycentric samples


@dataclass(frozen=True, eq=False)
class Appearance:
    """A glTF material. factor: (3,) linear, of the picture or alone; texture: its textureInfo;
    opacity: times the picture's alpha; cutoff: below it nothing is there, None where all is opaque.
    """

    factor: Array
    texture: dict[str, Any] | None
    opacity: float = 1.0
    cutoff: float | None = None

    @property
    def is_hidden(self) -> bool:
        """Whether nothing is there, whatever the picture."""
        return self.cutoff is not None and self.opacity < self.cutoff


def appearance(material: dict[str, Any]) -> Appearance:
    """Of a glTF material.

    Specular-glossiness goes before the metallic fallback, where it has a picture or the other has
    none. Emission stands for a base that is black or has no picture: so unlit photographs were
    written before KHR_materials_unlit.
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
    return Appearance(factor, texture, opacity, cutoff)


def cut_out(
    positions: Array,
    uvs: Float32,
    faces: NDArray[np.int32],
    opaque: NDArray[np.bool_],
    *,
    repeat: bool,
) -> tuple[Array, Float32, NDArray[np.int32]]:
    """A mesh without what its picture says is not there. opaque: (h, w) of texels; repeat: whether
    the picture goes on beyond its edges. Triangles across a border are cut, to within some texels.
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
    """Which triangles (F, 3, 2), texels, are opaque at half of their samples or more."""
    h, w = opaque.shape
    x, y = np.moveaxis(np.einsum("sk,fkc->fsc", _CENTRE, corners), -1, 0).astype(np.int64)
    return np.asarray(opaque[y % h, x % w].mean(axis=1) >= 0.5)


def _halved(
    positions: Array, uvs: Float32, faces: NDArray[np.int32]
) -> tuple[Array, Float32, NDArray[np.int32]]:
    """Each triangle as four, with vertices of their own."""
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
