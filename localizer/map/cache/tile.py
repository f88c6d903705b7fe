"""One drawable tile of the map: `TileMesh`, its texture layout for kernels, mips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array, Pose
from localizer.types import Float32, Image

_LARGEST_UV = 1e6
_PAIR_BYTES = 8  # two texels are read as one word of this size
_SMALLEST_MIP = 4  # texels on the longer side; below it a mip holds no more than a mean colour


@dataclass(frozen=True, eq=False)
class PackedTexture:
    """A mip chain in one buffer. texels: (T, 3) uint8 RGB, mip after mip, rows top to bottom;
    pairs: (T,) uint64, little endian, the six bytes of a texel and its successor (and two more);
    offsets: (L,) int64 first texel of each mip; sizes: (L, 2) int32 (width, height).
    """

    texels: Image
    pairs: NDArray[np.uint64]
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int32]

    @classmethod
    def empty(cls, sizes: Sequence[tuple[int, int]]) -> PackedTexture:
        """Room for mips of the given (width, height), finest first; texels are not set."""
        counts = [w * h for w, h in sizes]
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        total = int(offsets[-1])
        # The last texel's pair reaches past it. Overlapping words at any address: one load brings
        # what bilinear filtering needs of a row.
        buffer = np.zeros(3 * total + _PAIR_BYTES, np.uint8)
        texels = buffer[: 3 * total].reshape(total, 3)
        pairs = np.ndarray((total,), np.dtype("<u8"), buffer, strides=(3,))
        return cls(texels, pairs, offsets[:-1].copy(), np.asarray(sizes, np.int32).reshape(-1, 2))

    def mip(self, level: int) -> Image:
        """View (h, w, 3) of one level."""
        w, h = (int(n) for n in self.sizes[level])
        start = int(self.offsets[level])
        return self.texels[start : start + w * h].reshape(h, w, 3)


@dataclass(frozen=True, eq=False)
class TileMesh:
    """A textured triangle mesh with its pose in the world.

    positions: (V, 3) float32 metres, tile-local; uvs: (V, 2) float32, v down (texture row 0 is
    v = 0); faces: (F, 3) int32; mips: (h, w, 3) uint8 RGB each, finest first; world_from_tile: to
    ENU about the map's origin; repeat: texture coordinates wrap around instead of being clamped.
    """

    positions: Float32
    uvs: Float32
    faces: NDArray[np.int32]
    mips: tuple[Image, ...]
    world_from_tile: Pose
    repeat: bool = False

    @classmethod
    def from_packed(
        cls,
        positions: Float32,
        uvs: Float32,
        faces: NDArray[np.int32],
        texture: PackedTexture,
        world_from_tile: Pose,
        *,
        repeat: bool = False,
    ) -> TileMesh:
        """From a texture that is packed already; `mips` become views of it."""
        mips = tuple(texture.mip(i) for i in range(len(texture.sizes)))
        mesh = cls(positions, uvs, faces, mips, world_from_tile, repeat)
        mesh.__dict__["texture"] = texture  # fills the cached property
        return mesh

    @cached_property
    def texture(self) -> PackedTexture:
        """The mips in one buffer, as the CPU renderer reads them."""
        packed = PackedTexture.empty([(m.shape[1], m.shape[0]) for m in self.mips])
        for level, mip in enumerate(self.mips):
            packed.mip(level)[:] = mip
        return packed

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest tile-local corner, (3,) each."""
        if len(self.positions) == 0:
            return np.zeros(3), np.zeros(3)
        return (
            self.positions.min(axis=0).astype(np.float64),
            self.positions.max(axis=0).astype(np.float64),
        )

    @property
    def nbytes(self) -> int:
        """Bytes that the mesh holds in memory, its mips counted once."""
        own = self.positions.nbytes + self.uvs.nbytes + self.faces.nbytes
        return int(own + sum(m.nbytes for m in self.mips))

    def placed(self, world_from_tile: Pose) -> TileMesh:
        """The same mesh, with its arrays shared, at the pose world_from_tile."""
        return TileMesh.from_packed(
            self.positions,
            self.uvs,
            self.faces,
            self.texture,
            world_from_tile,
            repeat=self.repeat,
        )


def vector_area(positions: Array, faces: NDArray[np.int32]) -> Array:
    """Sum (3,) of triangle normals weighted by area, m². Opposite walls cancel, so a map's vector
    area points up.
    """
    a, b, c = (positions[faces[:, k]].astype(np.float64) for k in range(3))
    return np.asarray(0.5 * np.cross(b - a, c - a).sum(axis=0))


def orientation_fault(area: Array) -> str | None:
    """Why a map with this `vector_area` (ENU) is wrongly oriented; None if most of it faces up."""
    up, aside = float(area[2]), float(np.hypot(area[0], area[1]))
    if up >= aside:
        return None
    return "stands on its edge" if abs(up) < aside else "faces down"


def mesh_fault(
    positions: NDArray[np.floating[Any]],
    uvs: NDArray[np.floating[Any]],
    faces: NDArray[np.integer[Any]],
) -> str | None:
    """Why a mesh is invalid for the renderer's kernels, which check no index; None if it is valid.

    positions: (V, 3); uvs: (V, 2); faces: (F, 3).
    """
    if positions.ndim != 2 or positions.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        return "positions or faces are not rows of three"
    if uvs.shape != (len(positions), 2):
        return "there is not one texture coordinate for each vertex"
    if not np.isfinite(positions).all():
        return "a position is not finite"
    if not (np.abs(uvs) <= _LARGEST_UV).all():
        return "a texture coordinate is not finite or beyond all measure"
    if len(faces) and not (faces.min() >= 0 and faces.max() < len(positions)):
        return "a face names a vertex that is not there"
    return None


def mip_sizes(width: int, height: int) -> list[tuple[int, int]]:
    """(width, height) of every level, finest first."""
    sizes = [(width, height)]
    while max(sizes[-1]) > _SMALLEST_MIP:
        w, h = sizes[-1]
        sizes.append((max(1, w // 2), max(1, h // 2)))
    return sizes


def build_mips(image: Image, used: NDArray[np.bool_] | None = None) -> tuple[Image, ...]:
    """Mip chain of an RGB image (h, w, 3).

    used: (h, w), the texels that some triangle shows; None: all. Coarser mips average only those.
    Unused texels take their colour from the next coarser mip, so that the background of a texture
    atlas does not bleed into the chart borders.
    """
    h, w = image.shape[:2]
    mask = np.ones((h, w), np.uint8) if used is None else used.astype(np.uint8)
    count = cv2.countNonZero(mask)
    if count in (0, h * w):
        mips = [image]
        for size in mip_sizes(w, h)[1:]:
            mips.append(cv2.resize(mips[-1], size, interpolation=cv2.INTER_AREA).astype(np.uint8))
        return tuple(mips)
    # Colours times weight, and the weight itself, averaged alike.
    colour = cv2.bitwise_and(image, image, mask=mask)
    weight = mask.astype(np.float32)
    levels = []
    for size in mip_sizes(w, h)[1:]:
        colour = cv2.resize(colour, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        weight = cv2.resize(weight, size, interpolation=cv2.INTER_AREA).reshape(size[::-1])
        levels.append((colour.reshape(*size[::-1], 3), weight))
    filled: list[Image] = []
    coarser = np.array(cv2.mean(image, mask)[:3], np.float32).reshape(1, 1, 3)
    for colour, weight in reversed(levels):
        h, w = weight.shape
        coarser = cv2.resize(coarser, (w, h), interpolation=cv2.INTER_LINEAR).reshape(h, w, 3)
        scale = cv2.merge([1 / np.maximum(weight, 1e-3)] * 3).reshape(h, w, 3)
        mean = cv2.multiply(colour, scale)
        cv2.copyTo(mean, (weight > 1e-3).astype(np.uint8), coarser)
        filled.append(cv2.convertScaleAbs(coarser).reshape(h, w, 3).astype(np.uint8))
    return (image, *reversed(filled))


def texel_coverage(
    uvs: Float32, faces: NDArray[np.int32], width: int, height: int
) -> NDArray[np.bool_]:
    """(height, width) mask of the texels that the triangles show, borders included.

    uvs: (N, 2) texture coordinates, (0, 0) at the first texel's corner and (1, 1) at the last's;
    faces: (M, 3) indices of uvs.
    """
    mask = np.zeros((height, width), np.uint8)
    fixed = np.clip(uvs.astype(np.float64) * (width, height) - 0.5, -1, (width, height))
    triangles = np.rint(fixed).astype(np.int32)[faces]
    for triangle in triangles:  # fillPoly fills by parity: overlaps would cancel
        cv2.fillConvexPoly(mask, triangle, 1)
    return mask.astype(bool)
