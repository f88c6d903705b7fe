"""Rendering a lit height field by ray marching, on the CPU."""

# ruff: noqa: PLR0912, PLR0915 (kernels pass arrays and unroll sums, for speed)

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.synth.heightfield.scene import BLOCK, LitScene
from localizer.types import Float32, Image


def render(
    scene: LitScene, world_from_camera: Pose, camera: Camera, supersample: int = 1
) -> tuple[Image, Float32]:
    """Image (H, W, 3) uint8 and depth (H, W) float32 (metres along the axis, 0 = sky).

    Supersampling smooths the image; the depth is that of the pixel centres' nearest sample.
    """
    s = supersample
    big = camera.resized(camera.width * s, camera.height * s)
    image = np.zeros((big.height, big.width, 3), np.float32)
    depth = np.zeros((big.height, big.width), np.float32)
    levels = 1
    side = scene.height.shape[0]
    while side % 2 == 0 and side > 32:
        side //= 2
        levels += 1
    _march(
        scene.height,
        scene.block_max,
        scene.mips,
        levels,
        scene.prism,
        scene.facades,
        scene.cell_m,
        np.array([*scene.light.sun, scene.light.direct, scene.light.ambient]),
        np.array(scene.sky, np.float32),
        world_from_camera.rotation,
        world_from_camera.translation,
        np.array([big.fx, big.fy, big.cx, big.cy]),
        float(scene.height.max()),
        image,
        depth,
    )
    if s > 1:
        size = (camera.width, camera.height)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        depth = np.ascontiguousarray(depth[s // 2 :: s, s // 2 :: s])
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8), depth


@njit(cache=True, fastmath=True, nogil=True)
def _mirror(x: float, n: float) -> float:
    x = x - np.floor(x / (2 * n)) * 2 * n
    return 2 * n - x if x > n else x


@njit(cache=True, fastmath=True, nogil=True)
def _surface(height: Float32, x: float, y: float) -> float:
    """Bilinear height at cell coordinates, mirrored; cell centres at +0.5."""
    n = height.shape[0]
    a = min(max(_mirror(x, n) - 0.5, 0.0), n - 1.001)
    b = min(max(_mirror(y, n) - 0.5, 0.0), n - 1.001)
    i, j = int(b), int(a)
    u, v = a - j, b - i
    metres: float = (height[i, j] * (1 - u) + height[i, j + 1] * u) * (1 - v) + (
        height[i + 1, j] * (1 - u) + height[i + 1, j + 1] * u
    ) * v
    return metres


@njit(cache=True, fastmath=True, nogil=True)
def _march(
    height: Float32,
    block_max: Float32,
    mips: Float32,
    levels: int,
    prism: NDArray[np.int32],
    facades: Float32,
    cell: float,
    light: NDArray[np.float64],
    sky: Float32,
    rotation: NDArray[np.float64],
    center: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    top: float,
    image: Float32,
    depth: Float32,
) -> None:
    n = height.shape[0]
    rows, cols = depth.shape
    far = 6000.0 * cell
    pixel = 1.0 / intrinsics[0]
    for v in range(rows):
        for u in range(cols):
            a = (u + 0.5 - intrinsics[2]) / intrinsics[0]
            b = (v + 0.5 - intrinsics[3]) / intrinsics[1]
            dx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2]
            dy = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2]
            dz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2]
            image[v, u, 0], image[v, u, 1], image[v, u, 2] = sky[0], sky[1], sky[2]
            if dz > -1e-3:
                continue
            # Everything below is in cells; t stays metres along the axis.
            px, py = center[0] / cell, center[1] / cell
            rx, ry = dx / cell, dy / cell
            speed = max(np.sqrt(rx * rx + ry * ry), -0.7 * dz / cell)
            t = max((top - center[2]) / dz, 0.5)
            hit = False
            low = t
            while t < far:
                x, y, z = px + t * rx, py + t * ry, center[2] + t * dz
                bx, by = np.floor(x / BLOCK), np.floor(y / BLOCK)
                out = far
                if rx > 1e-9:
                    out = min(out, ((bx + 1) * BLOCK - px) / rx)
                elif rx < -1e-9:
                    out = min(out, (bx * BLOCK - px) / rx)
                if ry > 1e-9:
                    out = min(out, ((by + 1) * BLOCK - py) / ry)
                elif ry < -1e-9:
                    out = min(out, (by * BLOCK - py) / ry)
                out = max(out, t) + 1e-3 / speed
                peak = block_max[
                    int(min(_mirror((by + 0.5) * BLOCK, n) / BLOCK, n // BLOCK - 1)),
                    int(min(_mirror((bx + 0.5) * BLOCK, n) / BLOCK, n // BLOCK - 1)),
                ]
                if center[2] + out * dz > peak:
                    low = t
                    t = out
                    continue
                t = max(t, (peak - center[2]) / dz)
                step = 0.6 * max(1.0, 0.7 * t * pixel / cell) / speed
                while t < out:
                    z = center[2] + t * dz
                    if z <= _surface(height, px + t * rx, py + t * ry):
                        hit = True
                        break
                    low = t
                    t += step
                if hit:
                    break
                t = out
            if not hit:
                continue
            high = t
            for _ in range(10):
                mid = 0.5 * (low + high)
                if center[2] + mid * dz <= _surface(height, px + mid * rx, py + mid * ry):
                    high = mid
                else:
                    low = mid
            depth[v, u] = high
            x, y = _mirror(px + high * rx, n), _mirror(py + high * ry, n)
            z = center[2] + high * dz
            _shade(
                height, mips, levels, prism, facades, cell, light, x, y, z,
                high * pixel / cell, image, v, u,
            )  # fmt: skip


@njit(cache=True, fastmath=True, nogil=True)
def _shade(
    height: Float32,
    mips: Float32,
    levels: int,
    prism: NDArray[np.int32],
    facades: Float32,
    cell: float,
    light: NDArray[np.float64],
    x: float,
    y: float,
    z: float,
    footprint: float,
    image: Float32,
    v: int,
    u: int,
) -> None:
    """Colour of the surface at cell coordinates (x, y): facade on a prism's wall, else texture."""
    n = height.shape[0]
    j = int(min(max(x - 0.5, 0.0), n - 2.0))
    i = int(min(max(y - 0.5, 0.0), n - 2.0))
    h00, h01, h10, h11 = height[i, j], height[i, j + 1], height[i + 1, j], height[i + 1, j + 1]
    lowest, highest = min(h00, h01, h10, h11), max(h00, h01, h10, h11)
    if highest - lowest > 1.8 and highest - lowest > 1.5 * cell and z < highest - 0.3:
        owner = 0
        for k in range(4):
            r, c = i + k // 2, j + k % 2
            if height[r, c] == highest:
                owner = prism[r, c]
        if owner > 0:
            gx = 0.5 * (h01 - h00 + h11 - h10)
            gy = 0.5 * (h10 - h00 + h11 - h01)
            length = max(np.sqrt(gx * gx + gy * gy), 1e-6)
            nx, ny = -gx / length, -gy / length
            lit = light[4] * 0.8 + light[3] * max(0.0, nx * light[0] + ny * light[1])
            window = facades[owner, 3]
            if window > 0.0 and footprint * cell < 0.6 * window:
                along = (x * ny - y * nx) * cell / window
                storey = (highest - z) / 3.0
                if (along - np.floor(along)) > 0.55 and 0.3 < storey - np.floor(storey) < 0.8:
                    lit *= 0.35
            for c in range(3):
                image[v, u, c] = facades[owner, c] * lit
            return
    level = 0
    if footprint > 1.0:
        level = min(int(np.log2(footprint) + 0.5), levels - 1)
    offset = 0
    side = n
    for _ in range(level):
        offset += side * side * 3
        side //= 2
    a = min(max(x * side / n - 0.5, 0.0), side - 1.001)
    b = min(max(y * side / n - 0.5, 0.0), side - 1.001)
    j, i = int(a), int(b)
    p, q = a - j, b - i
    at = offset + (i * side + j) * 3
    below = at + side * 3
    for c in range(3):
        image[v, u, c] = (mips[at + c] * (1 - p) + mips[at + 3 + c] * p) * (1 - q) + (
            mips[below + c] * (1 - p) + mips[below + 3 + c] * p
        ) * q
