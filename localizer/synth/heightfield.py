"""Fast scenes for training: a height field with an orthotexture, ray-marched on the CPU.

A scene is a square of n x n cells, mirrored without end, so that an oblique view never leaves it.
Objects (buildings, cars) are prisms drawn into the height field, so that a query scene can lack
some of the reference's objects and have others. Walls get facades with windows when they are hit.
World axes: x along columns, y along rows, z up, metres; camera axes are OpenCV's.
"""

# ruff: noqa: PLR0912, PLR0915 (kernels pass arrays and unroll sums, for speed)

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.camera import Camera
from localizer.pose import Pose
from localizer.types import Float32, Image

BLOCK = 16  # cells per side of a block of the maximum grid; n must be a multiple of it


@dataclass(frozen=True)
class Prism:
    """A building or vehicle. corners: (4, 2) cells, in order; ridge_m: roof rise above the eaves
    along the longer axis (0 = flat); roof and wall: RGB albedo; window_m: window spacing, 0 = none.
    """

    corners: Float32
    height_m: float
    ridge_m: float
    roof: tuple[float, float, float]
    wall: tuple[float, float, float]
    window_m: float


@dataclass(frozen=True)
class Land:
    """The ground without objects. height: (n, n) float32 metres; albedo: (n, n, 3) float32."""

    height: Float32
    albedo: Float32
    cell_m: float


@dataclass(frozen=True)
class Light:
    """Sun and sky. sun: (3,) unit vector towards the sun; the intensities multiply albedo."""

    sun: tuple[float, float, float]
    direct: float
    ambient: float


@dataclass(frozen=True)
class Scene:
    """Land with objects, not yet lit. prism: (n, n) int32, index + 1 of the prism, 0 for land."""

    height: Float32
    albedo: Float32
    prism: NDArray[np.int32]
    facades: Float32
    cell_m: float


@dataclass(frozen=True)
class LitScene:
    """A scene under one light, ready to render. mips: flat float32 RGB of all texture levels."""

    height: Float32
    block_max: Float32
    mips: Float32
    prism: NDArray[np.int32]
    facades: Float32
    light: Light
    sky: tuple[float, float, float]
    cell_m: float


def compose(land: Land, prisms: Sequence[Prism]) -> Scene:
    """Draw the objects into the land."""
    height, albedo = land.height.copy(), land.albedo.copy()
    index = np.zeros(height.shape, np.int32)
    facades = np.zeros((len(prisms) + 1, 4), np.float32)
    for k, prism in enumerate(prisms):
        facades[k + 1] = (*prism.wall, prism.window_m)
        _draw_prism(height, albedo, index, land, prism, k + 1)
    return Scene(height, albedo, index, facades, land.cell_m)


def light_scene(
    scene: Scene, light: Light, sky: tuple[float, float, float], texel_cells: float = 1.0
) -> LitScene:
    """Shade the scene with sun, sky and cast shadows, and build what the ray marcher needs.

    texel_cells: size of a sample of the baked texture; above one it is coarser than the cells.
    """
    height, cell = scene.height, scene.cell_m
    gy, gx = np.gradient(height, cell)
    sx, sy, sz = light.sun
    cosine = np.clip((-gx * sx - gy * sy + sz) / np.sqrt(gx**2 + gy**2 + 1), 0, 1)
    if light.direct > 0.0:
        sunny = _cast_shadows(height, cell, sx, sy, sz, float(np.ptp(height)))
        cosine = cosine * cv2.GaussianBlur(sunny, (0, 0), 0.6)
    # Concave places see less sky.
    openness = np.clip(1.0 + (height - cv2.GaussianBlur(height, (0, 0), 4.0)) * 0.06, 0.55, 1.15)
    shade = light.ambient * openness + light.direct * cosine
    texture = scene.albedo * shade[..., None].astype(np.float32)
    block_max = cv2.dilate(height, np.ones((3, 3), np.uint8))
    n = height.shape[0]
    block_max = block_max.reshape(n // BLOCK, BLOCK, n // BLOCK, BLOCK).max((1, 3))
    if texel_cells > 1.0:
        side = max(round(n / texel_cells), 32)
        coarse = cv2.resize(texture, (side, side), interpolation=cv2.INTER_AREA)
        texture = cv2.resize(coarse, (n, n), interpolation=cv2.INTER_LINEAR)
    mips = [texture]
    while mips[-1].shape[0] % 2 == 0 and mips[-1].shape[0] > 32:
        side = mips[-1].shape[0] // 2
        mips.append(cv2.resize(mips[-1], (side, side), interpolation=cv2.INTER_AREA))
    flat = np.concatenate([m.ravel() for m in mips]).astype(np.float32)
    return LitScene(height, block_max, flat, scene.prism, scene.facades, light, sky, cell)


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


def without(prisms: Sequence[Prism], rng: np.random.Generator, share: float) -> list[Prism]:
    """The objects with a random share of them gone."""
    return [p for p in prisms if rng.random() >= share]


def height_at(scene: LitScene, x_m: float, y_m: float) -> float:
    """Surface height at a place of the first (unmirrored) square, metres."""
    n = scene.height.shape[0]
    col = int(np.clip(x_m / scene.cell_m, 0, n - 1))
    row = int(np.clip(y_m / scene.cell_m, 0, n - 1))
    return float(scene.height[row, col])


def _draw_prism(
    height: Float32,
    albedo: Float32,
    index: NDArray[np.int32],
    land: Land,
    prism: Prism,
    number: int,
) -> None:
    n = height.shape[0]
    lo = np.floor(prism.corners.min(0)).astype(int).clip(0, n)
    hi = (np.ceil(prism.corners.max(0)).astype(int) + 1).clip(0, n)
    if (hi - lo).min() <= 0:
        return
    window = (slice(lo[1], hi[1]), slice(lo[0], hi[0]))
    mask = np.zeros((hi[1] - lo[1], hi[0] - lo[0]), np.uint8)
    cv2.fillConvexPoly(mask, np.rint(prism.corners - lo).astype(np.int32), 1)
    inside = mask > 0
    if not inside.any():
        return
    base = float(land.height[window][inside].mean())
    top = np.full(mask.shape, base + prism.height_m, np.float32)
    center = prism.corners.mean(0) - lo
    along, across = prism.corners[1] - prism.corners[0], prism.corners[3] - prism.corners[0]
    if np.linalg.norm(along) < np.linalg.norm(across):
        along, across = across, along
    width = float(np.linalg.norm(across))
    rows, cols = np.mgrid[0 : mask.shape[0], 0 : mask.shape[1]].astype(np.float32)
    offset = ((cols - center[0]) * across[0] + (rows - center[1]) * across[1]) / max(width, 1e-3)
    if prism.ridge_m > 0.0:
        top += prism.ridge_m * np.clip(1 - 2 * np.abs(offset) / max(width, 1e-3), 0, 1)
    roof = np.asarray(prism.roof, np.float32)
    # Rows of tiles or seams, and weathering, make a roof more than one colour.
    seams = 1.0 + 0.06 * np.sin(2.1 * offset + 0.7 * number)[..., None]
    grain = land.albedo[window].mean(-1, keepdims=True)
    painted = roof * seams * (0.85 + 0.3 * grain / max(float(grain.mean()), 1e-3))
    height[window][inside] = top[inside]
    albedo[window][inside] = painted[inside]
    index[window][inside] = number


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
    return (height[i, j] * (1 - u) + height[i, j + 1] * u) * (1 - v) + (
        height[i + 1, j] * (1 - u) + height[i + 1, j + 1] * u
    ) * v


@njit(cache=True, fastmath=True, nogil=True)
def _cast_shadows(
    height: Float32, cell: float, sx: float, sy: float, sz: float, relief: float
) -> Float32:
    """(n, n) float32: 1 where the sun is seen, 0 in cast shadow."""
    n = height.shape[0]
    out = np.ones((n, n), np.float32)
    flat = max(np.sqrt(sx * sx + sy * sy), 1e-4)
    rise = sz / flat * cell  # metres per cell walked towards the sun
    dx, dy = sx / flat, sy / flat
    steps = int(min(relief / rise, 120.0)) + 1
    for i in range(n):
        for j in range(n):
            z = height[i, j] + 0.15
            for k in range(1, steps):
                x, y = j + dx * k, i + dy * k
                if x < 0 or y < 0 or x > n - 1 or y > n - 1:
                    break
                if height[int(y), int(x)] > z + rise * k:
                    out[i, j] = 0.0
                    break
    return out


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
