"""CPU renderer: RGB and metric depth by a rasteriser in numba, outside the GIL.

Two passes. Per mesh: transform the vertices to the image and list, per horizontal strip, the faces
that may cover a pixel centre (of small triangles most do not); faces that cross the near plane are
clipped into a short list of their own. Per strip: depth-tested filling of the listed faces, with
bilinear look-up in the mip that the pixel's footprint asks for. Both sides of a triangle are drawn:
photogrammetry is not consistently wound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.tile import TileMesh
from localizer.render.base import NEAR_M, SKY, MapRenderer, TileProvider
from localizer.render.raster_kernels import (
    clear,
    clip,
    depth_from_inverse,
    fill,
    list_faces,
    project,
)
from localizer.types import Float32, RenderedView

_FARTHEST_M = 1e9
_STRIPS_PER_THREAD = 2  # more than one, so that a crowded strip does not leave a thread idle


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Triangles after the first pass. screen: (V, 3) float32 x, y, 1/z; uvs: (V, 2) float32;
    faces: (F, 3) int32; listed: per strip (n,) int32, the faces to fill there.
    """

    screen: Float32
    uvs: Float32
    faces: NDArray[np.int32]
    listed: list[NDArray[np.int32]]
    mesh: TileMesh


class NumbaRenderer(MapRenderer):
    """Draws the tiles of a streamer on the CPU. One thread renders at a time."""

    def __init__(self, streamer: TileProvider, threads: int = 2) -> None:
        super().__init__(streamer)
        self.name = f"numba (CPU, {threads} threads)"
        self._sky = np.array(SKY, np.uint8)
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads, "raster") if threads > 1 else None
        self._vertices = np.empty((0, 3), np.float32)
        self._strips = threads * _STRIPS_PER_THREAD if threads > 1 else 1
        self._listed = np.empty((self._strips, 0), np.int32)

    def draw(
        self, meshes: Sequence[TileMesh], world_from_camera: Pose, camera: Camera
    ) -> RenderedView:
        """See `MapRenderer.draw`."""
        meshes = _front_to_back([m for m in meshes if len(m.faces)], world_from_camera)
        rgb = np.empty((camera.height, camera.width, 3), np.uint8)
        depth = np.empty((camera.height, camera.width), np.float32)
        flat_rgb, flat_depth = rgb.reshape(-1), depth.reshape(-1)
        strips = min(self._strips, camera.height)
        edges = [-(-camera.height * k // strips) for k in range(strips + 1)]
        groups = self._prepare(meshes, world_from_camera.inverse, camera, edges)
        prepared = [p for group in groups for p in group]

        def draw_strip(strip: int) -> None:
            y0, y1 = edges[strip], edges[strip + 1]
            clear(flat_rgb, flat_depth, self._sky, y0 * camera.width, y1 * camera.width)
            for p in prepared:
                listed = p.listed[strip]
                if len(listed):
                    t = p.mesh.texture
                    fill(
                        p.screen, p.uvs, p.faces, listed, p.mesh.repeat,
                        t.pairs, t.offsets, t.sizes, flat_rgb, flat_depth, camera.width, y0, y1,
                    )  # fmt: skip
            depth_from_inverse(flat_depth, y0 * camera.width, y1 * camera.width)

        self._map(draw_strip, range(strips))
        return RenderedView(rgb, depth, world_from_camera, camera)

    def close(self) -> None:
        """See `MapRenderer.close`."""
        if self._pool is not None:
            self._pool.shutdown()

    def _prepare(
        self, meshes: list[TileMesh], camera_from_world: Pose, camera: Camera, edges: list[int]
    ) -> list[list[_Prepared]]:
        vertices = np.cumsum([0, *(len(m.positions) for m in meshes)])
        faces = np.cumsum([0, *(len(m.faces) for m in meshes)])
        strips = len(edges) - 1
        if vertices[-1] > len(self._vertices):
            self._vertices = np.empty((int(1.3 * vertices[-1]), 3), np.float32)
        if faces[-1] > self._listed.shape[1]:
            self._listed = np.empty((self._strips, int(1.3 * faces[-1])), np.int32)
        strip_of_row = np.repeat(np.arange(strips), np.diff(edges))
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        near = np.float32(NEAR_M)

        def prepare(i: int) -> list[_Prepared]:
            mesh = meshes[i]
            # Composed in float64, so that only small numbers meet the float32 kernels.
            camera_from_tile = camera_from_world @ mesh.world_from_tile
            if not (np.abs(camera_from_tile.matrix) < _FARTHEST_M).all():
                return []  # a pose beyond all measure: float32 would overflow in the kernels
            T = np.ascontiguousarray(camera_from_tile.matrix[:3], np.float32)
            screen = self._vertices[vertices[i] : vertices[i + 1]]
            listed = self._listed[:, faces[i] : faces[i + 1]]
            counts = np.empty(strips, np.int64)
            project(mesh.positions, T, intrinsics, near, screen)
            crossing = list_faces(screen, mesh.faces, camera.width, strip_of_row, listed, counts)
            by_strip = [listed[s, :n] for s, n in enumerate(counts)]
            parts = [_Prepared(screen, mesh.uvs, mesh.faces, by_strip, mesh)]
            if crossing:
                cut = listed[0, listed.shape[1] - crossing :]
                points, uvs = clip(mesh.positions, mesh.uvs, mesh.faces, cut, T, intrinsics, near)
                corners = np.arange(len(points), dtype=np.int32)
                every = [corners[: len(points) // 3]] * strips
                parts.append(_Prepared(points, uvs, corners.reshape(-1, 3), every, mesh))
            return parts

        return self._map(prepare, range(len(meshes)))

    def _map(self, function: Callable[[int], Any], items: Iterable[int]) -> list[Any]:
        if self._pool is None:
            return [function(i) for i in items]
        return list(self._pool.map(function, items))


def _front_to_back(meshes: list[TileMesh], world_from_camera: Pose) -> list[TileMesh]:
    """The meshes, nearest first, so that most later pixels fail the depth test."""
    eye: Array = world_from_camera.translation

    def distance(mesh: TileMesh) -> float:
        low, high = mesh.bounds
        local = mesh.world_from_tile.rotation.T @ (eye - mesh.world_from_tile.translation)
        nearest = np.minimum(np.maximum(local, low), high)
        return float(((local - nearest) ** 2).sum())

    return sorted(meshes, key=distance)
