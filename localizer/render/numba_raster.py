"""CPU renderer: RGB and metric depth by a rasteriser in numba, outside the GIL.

Two passes. Per mesh: transform the vertices to the image and list the faces that may cover a pixel
centre (of small triangles most do not); faces that cross the near plane are clipped into a short
list of their own. Per horizontal strip: depth-tested filling of the listed faces, with bilinear
look-up in the mip that the pixel's footprint asks for. Both sides of a triangle are drawn:
photogrammetry is not consistently wound.
"""

# ruff: noqa: PLR0912, PLR0915 (kernels pass arrays and unroll, for speed)

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.camera import Camera
from localizer.map.tile import TileMesh
from localizer.pose import Array, Pose
from localizer.render.base import NEAR_M, SKY, TileProvider, is_visible, require_pinhole
from localizer.types import Float32, Image, RenderedView

_STRIPS_PER_THREAD = 2  # more than one, so that a crowded strip does not leave a thread idle


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Triangles after the first pass. screen: (V, 3) float32 x, y, 1/z; uvs: (V, 2) float32;
    faces: (F, 3) int32; listed: (n,) int32, the faces to fill; top, bottom: the rows they reach.
    """

    screen: Float32
    uvs: Float32
    faces: NDArray[np.int32]
    listed: NDArray[np.int32]
    mesh: TileMesh
    top: float
    bottom: float


class NumbaRenderer:
    """Draws the tiles of a streamer on the CPU. One thread renders at a time."""

    def __init__(
        self,
        streamer: TileProvider,
        threads: int = 2,
        sky: tuple[int, int, int] = SKY,
    ) -> None:
        self.name = f"numba (CPU, {threads} threads)"
        self.streamer = streamer
        self._sky = np.array(sky, np.uint8)
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads, "raster") if threads > 1 else None
        self._vertices = np.empty((0, 3), np.float32)
        self._faces = np.empty(0, np.int32)

    def warm_up(self) -> None:
        """Compile the kernels (seconds the first time, then cached on disk)."""
        corners = np.array([[-1, -1, 2], [1, -1, 2], [0, 1, 0.1]], np.float32)
        white = np.full((8, 8, 3), 255, np.uint8)
        mesh = TileMesh(
            corners,
            np.zeros((3, 2), np.float32),
            np.array([[0, 1, 2]], np.int32),
            (white,),
            Pose.identity(),
        )
        self.draw([mesh], Pose.identity(), Camera.from_fov(16, 16, 90.0))

    def render(
        self,
        world_from_camera: Pose,
        camera: Camera,
        extra: Sequence[TileMesh] = (),
        *,
        wait: bool = False,
    ) -> RenderedView:
        """See `MapRenderer.render`."""
        require_pinhole(camera)
        meshes = self.streamer.select(world_from_camera, camera, wait=wait)
        meshes = [*meshes, *(m for m in extra if is_visible(m, world_from_camera, camera))]
        return self.draw(meshes, world_from_camera, camera)

    def draw(
        self, meshes: Sequence[TileMesh], world_from_camera: Pose, camera: Camera
    ) -> RenderedView:
        """Draw just these meshes."""
        meshes = _front_to_back([m for m in meshes if len(m.faces)], world_from_camera)
        rgb = np.empty((camera.height, camera.width, 3), np.uint8)
        depth = np.empty((camera.height, camera.width), np.float32)
        parts = self._prepare(meshes, world_from_camera.inverse, camera)
        prepared = [p for group in parts for p in group if len(p.listed)]
        strips = self._threads * _STRIPS_PER_THREAD if self._threads > 1 else 1
        edges = np.linspace(0, camera.height, strips + 1).astype(int)

        def fill(strip: int) -> None:
            y0, y1 = int(edges[strip]), int(edges[strip + 1])
            _clear(rgb, depth, self._sky, y0, y1)
            for p in prepared:
                if p.bottom < y0 or p.top > y1:
                    continue
                t = p.mesh.texture
                _fill(
                    p.screen, p.uvs, p.faces, p.listed, p.mesh.repeat,
                    t.texels, t.offsets, t.sizes, rgb, depth, y0, y1,
                )  # fmt: skip
            _depth_from_inverse(depth, y0, y1)

        self._map(fill, range(strips))
        return RenderedView(rgb, depth, world_from_camera, camera)

    def close(self) -> None:
        """Stop the worker threads; the streamer is its owner's."""
        if self._pool is not None:
            self._pool.shutdown()

    def _prepare(
        self, meshes: list[TileMesh], camera_from_world: Pose, camera: Camera
    ) -> list[list[_Prepared]]:
        vertices = np.cumsum([0, *(len(m.positions) for m in meshes)])
        faces = np.cumsum([0, *(len(m.faces) for m in meshes)])
        if vertices[-1] > len(self._vertices):
            self._vertices = np.empty((int(1.3 * vertices[-1]), 3), np.float32)
        if faces[-1] > len(self._faces):
            self._faces = np.empty(int(1.3 * faces[-1]), np.int32)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)

        def prepare(i: int) -> list[_Prepared]:
            mesh = meshes[i]
            # Composed in float64, so that only small numbers meet the float32 kernels.
            camera_from_tile = camera_from_world @ mesh.world_from_tile
            T = np.ascontiguousarray(camera_from_tile.matrix[:3], np.float32)
            screen = self._vertices[vertices[i] : vertices[i + 1]]
            listed = self._faces[faces[i] : faces[i + 1]]
            near = np.float32(NEAR_M)
            _project(mesh.positions, T, intrinsics, near, screen)
            kept, crossing, top, bottom = _list_faces(
                screen, mesh.faces, camera.width, camera.height, listed
            )
            parts = [_Prepared(screen, mesh.uvs, mesh.faces, listed[:kept], mesh, top, bottom)]
            if crossing:
                cut = listed[len(listed) - crossing :]
                points, uvs = _clip(mesh.positions, mesh.uvs, mesh.faces, cut, T, intrinsics, near)
                corners = np.arange(len(points), dtype=np.int32)
                some = corners[: len(points) // 3]
                parts.append(
                    _Prepared(points, uvs, corners.reshape(-1, 3), some, mesh, 0, camera.height)
                )
            return parts

        return self._map(prepare, range(len(meshes)))

    def _map(self, function: Callable[[int], Any], items: Iterable[int]) -> list[Any]:
        if self._pool is None:
            return [function(i) for i in items]
        return list(self._pool.map(function, items))


def _front_to_back(meshes: list[TileMesh], world_from_camera: Pose) -> list[TileMesh]:
    """Nearest first: what is drawn later then mostly fails the depth test."""
    eye: Array = world_from_camera.translation

    def distance(mesh: TileMesh) -> float:
        low, high = mesh.bounds
        local = mesh.world_from_tile.rotation.T @ (eye - mesh.world_from_tile.translation)
        nearest = np.minimum(np.maximum(local, low), high)
        return float(((local - nearest) ** 2).sum())

    return sorted(meshes, key=distance)


@njit(cache=True, nogil=True, fastmath=True)
def _clear(rgb: Image, depth: Float32, sky: Image, y0: int, y1: int) -> None:
    for y in range(y0, y1):
        for x in range(depth.shape[1]):
            depth[y, x] = np.float32(0)
            rgb[y, x, 0] = sky[0]
            rgb[y, x, 1] = sky[1]
            rgb[y, x, 2] = sky[2]


@njit(cache=True, nogil=True)
def _depth_from_inverse(depth: Float32, y0: int, y1: int) -> None:
    for y in range(y0, y1):
        for x in range(depth.shape[1]):
            if depth[y, x] > np.float32(0):
                depth[y, x] = np.float32(1) / depth[y, x]


@njit(cache=True, nogil=True, fastmath=True)
def _project(positions, T, intrinsics, near, screen):  # type: ignore[no-untyped-def]
    """Vertices to (x, y, 1/z) in pixels and 1/m; 1/z is -1 for those before the near plane."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for i in range(positions.shape[0]):
        px, py, pz = positions[i, 0], positions[i, 1], positions[i, 2]
        z = r20 * px + r21 * py + r22 * pz + t2
        if z < near:
            screen[i, 2] = np.float32(-1)
        else:
            k = np.float32(1) / z
            screen[i, 0] = (r00 * px + r01 * py + r02 * pz + t0) * k * fx + cx
            screen[i, 1] = (r10 * px + r11 * py + r12 * pz + t1) * k * fy + cy
            screen[i, 2] = k


@njit(cache=True, nogil=True, fastmath=True)
def _list_faces(screen, faces, width, height, listed):  # type: ignore[no-untyped-def]
    """Faces that may cover a pixel centre, from the front of `listed`; faces that cross the near
    plane from its back. Returns both counts, and the first and last row of the former.
    """
    half = np.float32(0.5)
    right, bottom = np.float32(width) - half, np.float32(height) - half
    kept = 0
    crossing = 0
    top_row, bottom_row = np.float32(height), np.float32(0)
    last = listed.shape[0] - 1
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ia, ib, ic = screen[a, 2], screen[b, 2], screen[c, 2]
        if ia < 0 or ib < 0 or ic < 0:
            if ia > 0 or ib > 0 or ic > 0:
                listed[last - crossing] = f
                crossing += 1
            continue
        xa, xb, xc = screen[a, 0], screen[b, 0], screen[c, 0]
        x0, x1 = min(xa, xb, xc), max(xa, xb, xc)
        if x1 < half or x0 > right or np.ceil(x0 - half) > np.floor(x1 - half):
            continue
        ya, yb, yc = screen[a, 1], screen[b, 1], screen[c, 1]
        y0, y1 = min(ya, yb, yc), max(ya, yb, yc)
        if y1 < half or y0 > bottom or np.ceil(y0 - half) > np.floor(y1 - half):
            continue
        listed[kept] = f
        kept += 1
        top_row, bottom_row = min(top_row, y0), max(bottom_row, y1)
    return kept, crossing, top_row, bottom_row


@njit(cache=True, nogil=True)
def _clip(positions, uvs, faces, crossing, T, intrinsics, near):  # type: ignore[no-untyped-def]
    """Faces cut at the near plane, one or two triangles each: their corners as `_project` gives
    them (3 m, 3), and texture coordinates (3 m, 2).
    """
    screen = np.empty((6 * crossing.shape[0], 3), np.float32)
    cut_uvs = np.empty((6 * crossing.shape[0], 2), np.float32)
    corner = np.empty((3, 5), np.float32)  # camera x, y, z, then u, v
    polygon = np.empty((4, 5), np.float32)
    n = 0
    for i in range(crossing.shape[0]):
        for k in range(3):
            v = faces[crossing[i], k]
            for axis in range(3):
                corner[k, axis] = (
                    T[axis, 0] * positions[v, 0]
                    + T[axis, 1] * positions[v, 1]
                    + T[axis, 2] * positions[v, 2]
                    + T[axis, 3]
                )
            corner[k, 3], corner[k, 4] = uvs[v, 0], uvs[v, 1]
        count = 0
        for k in range(3):
            here, after = corner[k], corner[(k + 1) % 3]
            if here[2] >= near:
                polygon[count] = here
                count += 1
            if (here[2] >= near) != (after[2] >= near):
                s = (near - here[2]) / (after[2] - here[2])
                for q in range(5):
                    polygon[count, q] = here[q] + s * (after[q] - here[q])
                polygon[count, 2] = near
                count += 1
        for third in range(2, count):
            for k in (0, third - 1, third):
                inverse = np.float32(1) / polygon[k, 2]
                screen[n, 0] = polygon[k, 0] * inverse * intrinsics[0] + intrinsics[2]
                screen[n, 1] = polygon[k, 1] * inverse * intrinsics[1] + intrinsics[3]
                screen[n, 2] = inverse
                cut_uvs[n, 0], cut_uvs[n, 1] = polygon[k, 3], polygon[k, 4]
                n += 1
    return screen[:n], cut_uvs[:n]


@njit(cache=True, nogil=True, fastmath=True)
def _fill(  # type: ignore[no-untyped-def]
    screen, uvs, faces, listed, repeat, texels, offsets, sizes, rgb, inverse_depth, y0, y1
):
    """Fill the listed faces within rows y0 to y1. inverse_depth holds the nearest 1/z so far."""
    one, half, zero = np.float32(1), np.float32(0.5), np.float32(0)
    quarter = np.float32(0.25)
    slack = np.float32(-1e-5)  # rounding must not open cracks between neighbours
    top, bottom = np.float32(y0) + half, np.float32(y1) - half
    width = inverse_depth.shape[1]
    levels = sizes.shape[0]
    finest = np.float32(sizes[0, 0]) * np.float32(sizes[0, 1])
    for i in range(listed.shape[0]):
        f = listed[i]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ya, yb, yc = screen[a, 1], screen[b, 1], screen[c, 1]
        low, high = min(ya, yb, yc), max(ya, yb, yc)
        if high < top or low > bottom:
            continue
        xa, xb, xc = screen[a, 0], screen[b, 0], screen[c, 0]
        first_x = max(0, int(np.ceil(min(xa, xb, xc) - half)))
        last_x = min(width - 1, int(np.floor(max(xa, xb, xc) - half)))
        first_y = max(y0, int(np.ceil(low - half)))
        last_y = min(y1 - 1, int(np.floor(high - half)))

        # Set up in float64: corners of large triangles lie thousands of pixels outside the image,
        # where float32 would cost millimetres of depth. Along a row all is linear, for float32.
        ax, ay = np.float64(xa), np.float64(ya)
        bx, by, cx, cy = xb - ax, yb - ay, xc - ax, yc - ay
        area = bx * cy - cx * by
        if area == 0.0:
            continue
        inverse_area = 1.0 / area
        step_b, step_c = cy * inverse_area, -by * inverse_area
        ia, ib, ic = screen[a, 2], screen[b, 2], screen[c, 2]
        da, db, dc = np.float32(-step_b - step_c), np.float32(step_b), np.float32(step_c)
        d_iz = np.float32(step_b * (ib - ia) + step_c * (ic - ia))
        px = first_x + 0.5 - ax
        textured = False
        for y in range(first_y, last_y + 1):
            py = y + 0.5 - ay
            lb, lc = (cy * px - cx * py) * inverse_area, (bx * py - by * px) * inverse_area
            row_b, row_c = np.float32(lb), np.float32(lc)
            row_a = np.float32(1.0 - lb - lc)
            row_iz = np.float32(ia + lb * (ib - ia) + lc * (ic - ia))
            entered = False
            for x in range(first_x, last_x + 1):
                t = np.float32(x - first_x)
                wa, wb, wc = row_a + t * da, row_b + t * db, row_c + t * dc
                if wa < slack or wb < slack or wc < slack:
                    if entered:
                        break
                    continue
                entered = True
                iz = row_iz + t * d_iz
                if iz <= inverse_depth[y, x]:
                    continue
                inverse_depth[y, x] = iz
                if not textured:  # most listed faces show no pixel and never come here
                    textured = True
                    ua, va = uvs[a, 0], uvs[a, 1]
                    ub, vb = uvs[b, 0], uvs[b, 1]
                    uc, vc = uvs[c, 0], uvs[c, 1]
                    # Texels per pixel, as an area: the Jacobian of the perspective map is this
                    # constant times z^3.
                    texel_area = abs((ub - ua) * (vc - va) - (uc - ua) * (vb - va)) * finest
                    texel_area *= np.float32(abs(inverse_area)) * ia * ib * ic
                    ua, va, ub, vb, uc, vc = ua * ia, va * ia, ub * ib, vb * ib, uc * ic, vc * ic
                    level, shrink = 0, one  # shrink: 4 ** -level
                    w, h, base = sizes[0, 0], sizes[0, 1], offsets[0]
                z = one / iz
                footprint = texel_area * z * z * z
                while level < levels - 1 and footprint * shrink > np.float32(2):
                    level += 1
                    shrink *= quarter
                    w, h, base = sizes[level, 0], sizes[level, 1], offsets[level]
                while level > 0 and footprint * shrink < half:
                    level -= 1
                    shrink *= np.float32(4)
                    w, h, base = sizes[level, 0], sizes[level, 1], offsets[level]
                fw, fh = np.float32(w), np.float32(h)
                u = (wa * ua + wb * ub + wc * uc) * z
                v = (wa * va + wb * vb + wc * vc) * z
                if repeat:
                    u -= np.floor(u)
                    v -= np.floor(v)
                u = min(max(u * fw - half, zero), fw - one)
                v = min(max(v * fh - half, zero), fh - one)
                iu, iv = np.int32(u), np.int32(v)
                wu = np.int32((u - np.float32(iu)) * np.float32(256))
                wv = np.int32((v - np.float32(iv)) * np.float32(256))
                k = base + iv * w + iu
                right = 1 if iu + 1 < w else 0
                down = w if iv + 1 < h else 0
                for q in range(3):
                    upper = (
                        np.int32(texels[k, q]) * (256 - wu) + np.int32(texels[k + right, q]) * wu
                    )
                    lower = (
                        np.int32(texels[k + down, q]) * (256 - wu)
                        + np.int32(texels[k + down + right, q]) * wu
                    )
                    rgb[y, x, q] = (upper * (256 - wv) + lower * wv) >> 16
