"""Changes the fine texture between two visits to a place.

The map's texture was taken once. Until the flight, grass, crops, litter, bare soil and water get
another fine texture; their layout and hard surfaces stay. Each function models one of these
(model-card.md), for training places and for flown worlds.
"""

from __future__ import annotations

import cv2
import numpy as np

from localizer.types import Float32, Image

_REGROWN_M = (0.6, 2.5)  # scale below which soft ground does not repeat
_KEPT = 0.35  # largest share of that fine texture which is still the map's own


def hard_surfaces(texture: Image) -> Float32:
    """Mask (H, W), 0 to 1, of pavement and roofs in a photo: grey, blue or strongly red, unlike
    vegetation or soil, which are green to yellow-brown.
    """
    smooth = cv2.GaussianBlur(texture.astype(np.float32), (0, 0), 1.5)
    red, green, blue = smooth[..., 0], smooth[..., 1], smooth[..., 2]
    soft = np.clip((green - blue - 4.0) / 10.0, 0, 1) * np.clip((40.0 - (red - green)) / 15.0, 0, 1)
    hard: Float32 = (1.0 - soft).astype(np.float32)
    return hard


def with_new_texture(
    albedo: Float32,
    lasting: Float32,
    cell_m: float,
    rng: np.random.Generator,
    other_texture: Float32 | None = None,
) -> Float32:
    """The albedo (n, n, 3) with new fine texture of the same strength on soft ground.

    lasting: (n, n) in 0..1, one on roads, roofs and pavement. other_texture: the same ground with
    another fine texture; None: texture from elsewhere in the place, or noise.
    """
    sigma = max(float(np.exp(rng.uniform(*np.log(_REGROWN_M)))) / cell_m, 0.7)
    base, detail, spread = _fine_texture(albedo, sigma)
    n = albedo.shape[0]
    if other_texture is not None:
        _, other, its_spread = _fine_texture(other_texture, sigma)
        other = other / its_spread
    elif rng.random() < 0.5:
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


def _fine_texture(albedo: Float32, sigma: float) -> tuple[Float32, Float32, Float32]:
    """What is coarser than `sigma` (pixels), what is finer, and its strength (n, n, 1)."""
    base = cv2.GaussianBlur(albedo, (0, 0), sigma)
    detail = albedo - base
    power = cv2.GaussianBlur((detail**2).mean(-1), (0, 0), 2 * sigma)
    return np.asarray(base), np.asarray(detail), np.sqrt(power + 1e-8)[..., None]


def with_wet_patches(
    albedo: Float32,
    lasting: Float32,
    rng: np.random.Generator,
    patches: Float32 | None = None,
) -> Float32:
    """The albedo with patches of hard surface darker or paler: wet, dry, worn, dusty.

    patches: noise (n, n) that places them; None: drawn.
    """
    n = albedo.shape[0]
    field = noise(n, rng, 8, 3, 0.6) if patches is None else patches
    where = np.clip(0.5 + 0.6 * field, 0, 1)
    gain = 1 + lasting * (np.float32(rng.uniform(0.5, 1.25)) - 1) * where
    changed: Float32 = (albedo * gain[..., None]).astype(np.float32)
    return changed


def coarser(image: Image, texel_px: float) -> Image:
    """The image (same size) with one texture sample per `texel_px` pixels."""
    if texel_px <= 1.0:
        return image
    height, width = image.shape[:2]
    size = (max(int(width / texel_px), 8), max(int(height / texel_px), 8))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    out: Image = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return out


def draw_texel(rng: np.random.Generator) -> float:
    """Random ratio of map texel to query pixel on the ground, 1 to 4."""
    return float(np.exp(rng.uniform(0.0, np.log(4.0))))


def noise(n: int, rng: np.random.Generator, base: int, octaves: int, gain: float) -> Float32:
    """Fractal value noise (n, n) of zero mean. base: cells of the coarsest octave, doubled in each;
    gain: amplitude of an octave over the one before.
    """
    out: Float32 = np.zeros((n, n), np.float32)
    amplitude = np.float32(1.0)
    for octave in range(octaves):
        k = min(base * 2**octave, n) + 3
        grid = rng.standard_normal((k, k), dtype=np.float32)
        out += amplitude * cv2.resize(grid, (n, n), interpolation=cv2.INTER_CUBIC)
        amplitude *= np.float32(gain)
    return out
