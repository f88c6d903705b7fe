"""Fractal value noise for generated ground."""

from __future__ import annotations

import cv2
import numpy as np

from localizer.types import Float32


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
