"""Fast scenes for training: a height field with an orthotexture, ray-marched on the CPU.

A scene is a square of n x n cells, mirrored without end, so that an oblique view never leaves it.
Objects (buildings, cars) are prisms drawn into the height field, so that a query scene can lack
some of the reference's objects and have others. Walls get facades with windows when they are hit.
World axes: x along columns, y along rows, z up, metres; camera axes are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.types import Float32

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
class SkyLight:
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
    light: SkyLight
    sky: tuple[float, float, float]
    cell_m: float


def compose(land: Land, prisms: Sequence[Prism]) -> Scene:
    """A scene of a copy of the land with the objects on it."""
    height, albedo = land.height.copy(), land.albedo.copy()
    index = np.zeros(height.shape, np.int32)
    facades = np.zeros((len(prisms) + 1, 4), np.float32)
    for k, prism in enumerate(prisms):
        facades[k + 1] = (*prism.wall, prism.window_m)
        _draw_prism(height, albedo, index, land, prism, k + 1)
    return Scene(height, albedo, index, facades, land.cell_m)


def light_scene(
    scene: Scene,
    light: SkyLight,
    sky: tuple[float, float, float],
    texel_cells: float = 1.0,
) -> LitScene:
    """Shade the scene with sun, sky and cast shadows, and prepare it for ray marching.

    texel_cells: size of a sample of the baked texture; above one it is coarser than the cells.
    """
    height, cell = scene.height, scene.cell_m
    gy, gx = np.gradient(height, cell)
    sx, sy, sz = light.sun
    cosine = np.clip((-gx * sx - gy * sy + sz) / np.sqrt(gx**2 + gy**2 + 1), 0, 1)
    if light.direct > 0.0:
        sunny = cast_shadows(height, cell, sx, sy, sz, float(np.ptp(height)))
        cosine = cosine * cv2.GaussianBlur(sunny, (0, 0), 0.6)
    shade = light.ambient * openness(height) + light.direct * cosine
    texture = scene.albedo * shade[..., None].astype(np.float32)
    return bake_texture(scene, texture, light, sky, texel_cells)


def openness(height: Float32) -> Float32:
    """(n, n): factor of the sky's light, 0.55 to 1.15; less in concave places."""
    seen: Float32 = np.clip(
        1.0 + (height - cv2.GaussianBlur(height, (0, 0), 4.0)) * 0.06, 0.55, 1.15
    )
    return seen


def bake_texture(
    scene: Scene,
    texture: Float32,
    light: SkyLight,
    sky: tuple[float, float, float],
    texel_cells: float = 1.0,
) -> LitScene:
    """The scene with a given texture (n, n, 3), prepared for ray marching. texel_cells: as of
    `light_scene`.
    """
    height, cell = scene.height, scene.cell_m
    n = height.shape[0]
    if texel_cells > 1.0:
        side = max(round(n / texel_cells), 32)
        coarse = cv2.resize(texture, (side, side), interpolation=cv2.INTER_AREA)
        texture = cv2.resize(coarse, (n, n), interpolation=cv2.INTER_LINEAR)
    mips = [texture]
    while mips[-1].shape[0] % 2 == 0 and mips[-1].shape[0] > 32:
        side = mips[-1].shape[0] // 2
        mips.append(cv2.resize(mips[-1], (side, side), interpolation=cv2.INTER_AREA))
    flat = np.concatenate([m.ravel() for m in mips]).astype(np.float32)
    maxima = block_maxima(height)
    return LitScene(height, maxima, flat, scene.prism, scene.facades, light, sky, cell)


def block_maxima(height: Float32) -> Float32:
    """The highest cell in and beside each block of the height field (n, n)."""
    n = height.shape[0]
    raised = cv2.dilate(height, np.ones((3, 3), np.uint8))
    highest: Float32 = raised.reshape(n // BLOCK, BLOCK, n // BLOCK, BLOCK).max((1, 3))
    return highest


def omit_randomly(prisms: Sequence[Prism], rng: np.random.Generator, share: float) -> list[Prism]:
    """The objects; each one is left out with the probability `share`."""
    return [p for p in prisms if rng.random() >= share]


def height_at(scene: LitScene, x_m: float, y_m: float) -> float:
    """Surface height (m) at a position in the first (unmirrored) square."""
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
def cast_shadows(
    height: Float32, cell: float, sx: float, sy: float, sz: float, relief: float
) -> Float32:
    """(n, n) float32: 1 where the sun (unit vector sx, sy, sz) is visible, 0 in cast shadow. cell:
    side of a cell, m; relief: largest height difference, m.
    """
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
