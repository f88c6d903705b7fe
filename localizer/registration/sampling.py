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


def sample_map(values: Float32, x: Array, y: Array) -> Array:
    """`sample_features` of one channel (h, w): values (N,)."""
    return sample_features(values[..., None], x, y)[:, 0].astype(np.float64)


def structure_tensors(
    features: Float32, anchors: Float32, x: Array, y: Array
) -> tuple[Array, Array, Array]:
    """Equation 7 of anchors (N, C) at index coordinates inside the features (h, w, C): S (N, 2, 2),
    b (N, 2), and the squared residual norms (N,).
    """
    tensors, slopes, squares = np.empty((len(x), 2, 2)), np.empty((len(x), 2)), np.empty(len(x))
    _reduce(features, anchors, x, y, tensors, slopes, squares)
    return tensors, slopes, squares


@njit(**JIT)
def _reduce(features, anchors, x, y, tensors, slopes, squares):  # type: ignore[no-untyped-def]
    for k in range(len(x)):
        i, j = int(x[k]), int(y[k])
        a, b = np.float32(x[k] - i), np.float32(y[k] - j)
        A = B = D = p = q = e = np.float32(0)
        for c in range(features.shape[2]):
            left, right = features[j, i, c], features[j, i + 1, c]
            d0, d1 = right - left, features[j + 1, i + 1, c] - features[j + 1, i, c]
            top = left + a * d0
            gy = features[j + 1, i, c] + a * d1 - top
            gx = d0 + b * (d1 - d0)
            r = top + b * gy - anchors[k, c]
            A += gx * gx
            B += gx * gy
            D += gy * gy
            p += gx * r
            q += gy * r
            e += r * r
        tensors[k, 0, 0], tensors[k, 0, 1], tensors[k, 1, 0], tensors[k, 1, 1] = A, B, B, D
        slopes[k, 0], slopes[k, 1], squares[k] = p, q, e


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
