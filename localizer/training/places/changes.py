"""The surface that photogrammetry leaves of a training place: rounded, bumpy, without windows.

What the ground's texture becomes between two visits is `localizer.synth.visits.texture`.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from localizer.synth.heightfield.scene import LitScene, Prism, block_maxima
from localizer.synth.visits.texture import noise
from localizer.types import Float32

_MESH_M = (0.3, 2.0)  # horizontal resolution of a photogrammetric surface
_BUMPS_M = (0.03, 0.25)  # its vertical noise


def coarse_mesh(scene: LitScene, rng: np.random.Generator) -> LitScene:
    """The scene's height field as photogrammetry gives it: rounded edges and bumps. Prisms stay as
    they are. The side of the height field, in cells, must be a multiple of `BLOCK`.
    """
    n, cell = scene.height.shape[0], scene.cell_m
    factor = float(np.exp(rng.uniform(*np.log(_MESH_M)))) / cell
    height = scene.height
    if factor > 1.0:
        side = max(int(n / min(factor, 6.0)), 64)
        small = cv2.resize(height, (side, side), interpolation=cv2.INTER_AREA)
        height = cv2.resize(small, (n, n), interpolation=cv2.INTER_LINEAR)
    bumps = noise(n, rng, max(int(n * cell / 8.0), 4), 2, 0.5)
    height = (height + np.float32(rng.uniform(*_BUMPS_M)) * bumps).astype(np.float32)
    return replace(scene, height=height, block_max=block_maxima(height))


def plain_walls(prisms: list[Prism]) -> list[Prism]:
    """The buildings as seen from above only: walls without windows."""
    return [replace(p, window_m=0.0) for p in prisms]


Color = tuple[float, float, float]


def season_shift(albedo: Float32, rng: np.random.Generator) -> Float32:
    """The ground at another time of the year: vegetation recoloured, tones remapped, wetness."""
    red, green, blue = albedo[..., 0], albedo[..., 1], albedo[..., 2]
    leafy = np.clip((green - np.maximum(red, blue)) * 9.0, 0, 1)[..., None]
    kind = rng.choice(4)
    targets: tuple[Color, ...] = ((0.52, 0.45, 0.26), (0.5, 0.3, 0.12), (0.2, 0.36, 0.1))
    out = albedo
    if kind < 3:
        gray = albedo.mean(-1, keepdims=True)
        target = np.asarray(targets[kind], np.float32) * (gray / 0.3) ** rng.uniform(0.3, 1.0)
        mix = np.float32(rng.uniform(0.2, 0.9))
        patches = np.clip(0.7 + 0.4 * noise(albedo.shape[0], rng, 6, 3, 0.6), 0, 1)[..., None]
        out = out + leafy * mix * patches * (target - out)
    if rng.random() < 0.6:
        out = _remap(out, rng)
    gain = 1.0 + 0.12 * noise(albedo.shape[0], rng, 4, 4, 0.6)[..., None]
    return np.clip(out * gain, 0.02, 1.2).astype(np.float32)


def _remap(albedo: Float32, rng: np.random.Generator) -> Float32:
    """A smooth random change of tones and hues."""
    mix = np.eye(3) + rng.normal(0, 0.1, (3, 3))
    mixed = np.clip(albedo.reshape(-1, 3) @ mix.astype(np.float32), 0, 1).reshape(albedo.shape)
    knots = np.linspace(0, 1, 6)
    grid = np.linspace(0, 1, 256)
    out = np.empty_like(albedo)
    shared = rng.normal(0, 0.08, 6)
    indices = (mixed * 255).astype(np.uint8)
    for c in range(3):
        curve = np.interp(grid, knots, knots + shared + rng.normal(0, 0.04, 6))
        out[..., c] = curve.astype(np.float32)[indices[..., c]]
    return out
