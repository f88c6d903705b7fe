"""What differs between a surveyed map and the same place on the day of a flight.

The map's texture was baked once, at the survey's resolution, onto a coarse mesh. Until the flight,
grass, crops, leaf litter, bare soil and water have taken another fine texture: what lasts is their
layout, and hard surfaces. Each function stands for one of these (docs/model-card.md).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from localizer.synth.heightfield.scene import BLOCK, LitScene, Prism
from localizer.training.places.noise import noise
from localizer.types import Float32, Image

_REGROWN_M = (0.6, 2.5)  # scale below which soft ground does not repeat
_KEPT = 0.35  # largest share of that fine texture which is still the map's own
_MESH_M = (0.3, 2.0)  # horizontal resolution of a photogrammetric surface
_BUMPS_M = (0.03, 0.25)  # its vertical noise


def hard_surfaces(texture: Image) -> Float32:
    """Where a photo shows grey, blue or strongly red ground: pavement and roofs, not vegetation or
    soil, which are green to yellow-brown.
    """
    smooth = cv2.GaussianBlur(texture.astype(np.float32), (0, 0), 1.5)
    red, green, blue = smooth[..., 0], smooth[..., 1], smooth[..., 2]
    soft = np.clip((green - blue - 4.0) / 10.0, 0, 1) * np.clip((40.0 - (red - green)) / 15.0, 0, 1)
    hard: Float32 = (1.0 - soft).astype(np.float32)
    return hard


def regrown(albedo: Float32, lasting: Float32, cell_m: float, rng: np.random.Generator) -> Float32:
    """The albedo (n, n, 3) with new fine texture of the same strength where nothing lasts.

    lasting: (n, n) in 0..1, one on roads, roofs and pavement.
    """
    sigma = max(float(np.exp(rng.uniform(*np.log(_REGROWN_M)))) / cell_m, 0.7)
    base = cv2.GaussianBlur(albedo, (0, 0), sigma)
    detail = albedo - base
    power = cv2.GaussianBlur((detail**2).mean(-1), (0, 0), 2 * sigma)
    spread = np.sqrt(power + 1e-8)[..., None]
    n = albedo.shape[0]
    if rng.random() < 0.5:
        # Texture of the same place from elsewhere in it.
        shift = rng.integers(n // 4, 3 * n // 4, 2)
        other = np.roll(np.rot90(detail / spread, int(rng.integers(4))), shift, (0, 1))
    else:
        field = noise(n, rng, int(n / (3 * sigma)) + 1, 3, float(rng.uniform(0.6, 1.2)))
        other = (field / field.std())[..., None]
    kept = np.maximum(lasting, np.float32(rng.uniform(0, _KEPT)))[..., None]
    fresh = np.clip(other, -3, 3) * spread * np.float32(rng.uniform(0.7, 1.4))
    out = base + kept * detail + np.sqrt(1 - kept**2) * fresh
    changed: Float32 = np.clip(out, 0.02, 1.2).astype(np.float32)
    return changed


def wetted(albedo: Float32, lasting: Float32, rng: np.random.Generator) -> Float32:
    """Hard surfaces darker or paler than in the map, in patches: wet, dry, worn, dusty."""
    n = albedo.shape[0]
    patches = np.clip(0.5 + 0.6 * noise(n, rng, 8, 3, 0.6), 0, 1)
    gain = 1 + lasting * (np.float32(rng.uniform(0.5, 1.25)) - 1) * patches
    changed: Float32 = (albedo * gain[..., None]).astype(np.float32)
    return changed


def coarse_mesh(scene: LitScene, rng: np.random.Generator) -> LitScene:
    """The scene on the surface that photogrammetry gives: rounded edges, bumps, soft facades."""
    n, cell = scene.height.shape[0], scene.cell_m
    factor = float(np.exp(rng.uniform(*np.log(_MESH_M)))) / cell
    height = scene.height
    if factor > 1.0:
        side = max(int(n / min(factor, 6.0)), 64)
        small = cv2.resize(height, (side, side), interpolation=cv2.INTER_AREA)
        height = cv2.resize(small, (n, n), interpolation=cv2.INTER_LINEAR)
    bumps = noise(n, rng, max(int(n * cell / 8.0), 4), 2, 0.5)
    height = (height + np.float32(rng.uniform(*_BUMPS_M)) * bumps).astype(np.float32)
    raised = cv2.dilate(height, np.ones((3, 3), np.uint8))
    block_max = raised.reshape(n // BLOCK, BLOCK, n // BLOCK, BLOCK).max((1, 3))
    return replace(scene, height=height, block_max=block_max)


def plain_walls(prisms: list[Prism]) -> list[Prism]:
    """The buildings as seen from above only: walls without windows."""
    return [replace(p, window_m=0.0) for p in prisms]


def coarser(image: Image, texel_px: float) -> Image:
    """An image whose texture has one sample every `texel_px` pixels."""
    if texel_px <= 1.0:
        return image
    height, width = image.shape[:2]
    size = (max(int(width / texel_px), 8), max(int(height / texel_px), 8))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    out: Image = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return out


def draw_texel(rng: np.random.Generator) -> float:
    """Ground size of a map texel over that of a query pixel, 1 to 4."""
    return float(np.exp(rng.uniform(0.0, np.log(4.0))))
