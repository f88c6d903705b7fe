"""Meshes whose vertices point into charts (small images), and packing charts into atlases."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.types import Image


@dataclass(frozen=True)
class ChartedMesh:
    """positions (V, 3) float64 ENU; chart (V,) int64 index of the vertex's image; st (V, 2)
    float64 place in it, in texels from its top-left corner; faces (F, 3) int64; levels (F,) uint8
    bits of the levels of detail that show the face; charts: (h, w, 3) images.
    """

    positions: Array
    chart: NDArray[np.int64]
    st: Array
    faces: NDArray[np.int64]
    levels: NDArray[np.uint8]
    charts: tuple[Image, ...]

    @classmethod
    def empty(cls) -> ChartedMesh:
        """A mesh of nothing."""
        none = np.zeros(0, np.int64)
        return cls(
            np.zeros((0, 3)), none, np.zeros((0, 2)), none.reshape(0, 3), np.zeros(0, np.uint8), ()
        )

    @classmethod
    def merged(cls, parts: list[ChartedMesh]) -> ChartedMesh:
        """All parts as one mesh."""
        if not parts:
            return cls.empty()
        vertices = np.cumsum([0] + [len(p.positions) for p in parts])
        images = np.cumsum([0] + [len(p.charts) for p in parts])
        return cls(
            np.concatenate([p.positions for p in parts]),
            np.concatenate([p.chart + k for p, k in zip(parts, images, strict=False)]),
            np.concatenate([p.st for p in parts]),
            np.concatenate([p.faces + k for p, k in zip(parts, vertices, strict=False)]),
            np.concatenate([p.levels for p in parts]),
            tuple(c for p in parts for c in p.charts),
        )

    def at_level(self, level: int) -> ChartedMesh:
        """Only the faces of a level, with the vertices and charts that they use."""
        keep = (self.levels & level) > 0
        faces = self.faces[keep]
        used, faces_new = np.unique(faces, return_inverse=True)
        charts, chart_new = np.unique(self.chart[used], return_inverse=True)
        return ChartedMesh(
            self.positions[used], chart_new.reshape(-1), self.st[used],
            faces_new.reshape(-1, 3), self.levels[keep], tuple(self.charts[k] for k in charts),
        )  # fmt: skip

    def halved(self, times: int = 1) -> ChartedMesh:
        """The same mesh with charts of half the resolution, `times` over."""
        factor = 2**times
        charts, scale = [], np.ones((len(self.charts), 2))
        for k, image in enumerate(self.charts):
            h, w = image.shape[:2]
            size = (max(1, -(-w // factor)), max(1, -(-h // factor)))
            scale[k] = size[0] / w, size[1] / h
            charts.append(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        st = self.st * scale[self.chart] if len(self.st) else self.st
        return ChartedMesh(self.positions, self.chart, st, self.faces, self.levels, tuple(charts))


@dataclass(frozen=True)
class Atlas:
    """image: (H, W, 3); ground: top-left texel of the ground part; offsets: (C, 2) of charts."""

    image: Image
    ground: tuple[int, int]
    offsets: Array


def pack(ground: Image, charts: tuple[Image, ...], gutter: int, pad: int) -> Atlas:
    """Pack the textures of a tile into one image: the ground, framed by a gutter, and below it the
    charts in rows. gutter, pad: pixels around the ground and around each chart.

    Borders repeat the edge texels, so that filtering does not mix neighbours.
    """
    side_h, side_w = ground.shape[:2]
    width = side_w + 2 * gutter
    order = sorted(range(len(charts)), key=lambda k: -charts[k].shape[0])
    offsets = np.zeros((len(charts), 2))
    x, y, shelf = 0, side_h + 2 * gutter, 0
    for k in order:
        h, w = charts[k].shape[0] + 2 * pad, charts[k].shape[1] + 2 * pad
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        shelf = max(shelf, h)
        offsets[k] = x + pad, y + pad
        x += w
    height = -(-(y + shelf) // 32) * 32
    image = np.full((height, width, 3), 128, np.uint8)
    image[: side_h + 2 * gutter] = cv2.copyMakeBorder(
        ground, gutter, gutter, gutter, gutter, cv2.BORDER_REPLICATE
    )
    for k, (u, v) in enumerate(offsets.astype(int)):
        framed = np.pad(charts[k], ((pad, pad), (pad, pad), (0, 0)), mode="edge")
        h, w = framed.shape[:2]
        image[v - pad : v - pad + h, u - pad : u - pad + w] = framed
    return Atlas(image, (gutter, gutter), offsets)
