"""The ground of a training place at another time of the year."""

from __future__ import annotations

import numpy as np

from localizer.synth.visits.noise import noise
from localizer.types import Float32

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
