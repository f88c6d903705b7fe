"""Projection and bilinear sampling of many anchors, compiled: what every frame needs.

On arrays of a few thousand numbers NumPy spends its time between the steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.registration.backend import LevelProblem
from localizer.registration.cpu.algebra import JIT
from localizer.registration.cpu.reference import MIN_DEPTH
from localizer.types import Float32


class SeenAnchors(NamedTuple):
    """The n anchors in view. anchor: (n,) their indices; x: (n, 3) in the camera frame; u, v: (n,)
    array index coordinates; confidence: (n,) the query's there.
    """

    anchor: NDArray[np.int64]
    x: Array
    u: Array
    v: Array
    confidence: Array


def seen_anchors(
    problem: LevelProblem, rotation: Array, translation: Array, border: int = 0
) -> SeenAnchors:
    """`reference.project` and `reference.in_view` at a pose camera_from_local. border: cells at the
    image's edge that do not count as in view.
    """
    anchor = np.empty(problem.points.shape[1], np.int64)
    rows = np.empty((len(anchor), 6))
    n = _see(
        np.ascontiguousarray(rotation), translation, problem.points, problem.confidence,
        (*problem.focal, *problem.centre, float(border)), anchor, rows,
    )  # fmt: skip
    rows = rows[:n]
    return SeenAnchors(anchor[:n], rows[:, :3], rows[:, 3], rows[:, 4], rows[:, 5])


def projection_jacobians(problem: LevelProblem, x: Array, translation: Array) -> Array:
    """`reference.projection_jacobian`, (N, 2, 6)."""
    out = np.zeros((len(x), 2, 6))
    _differentiate(x, translation, problem.focal, out)
    return out


def numbered(key: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """The keys (N,), small and not negative, as numbers from 0 on in the same order, and how many
    numbers there are.
    """
    used = np.bincount(key) > 0
    number = np.cumsum(used) - 1
    return number[key], int(used.sum())


def sample_features(features: Float32, x: Array, y: Array) -> Float32:
    """`sample_bilinear` of features (h, w, C): values (N, C) float32 at index coordinates, clamped.

    It is compiled, and ten times as fast as NumPy.
    """
    out = np.empty((len(x), features.shape[2]), np.float32)
    _sample(features, x, y, out)
    return out


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
def _see(R, t, points, confidence, numbers, anchor, rows):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy, border = numbers
    h, w = confidence.shape
    n = 0
    for k in range(len(anchor)):
        X, Y, Z = np.float64(points[0, k]), np.float64(points[1, k]), np.float64(points[2, k])
        z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
        if not z > MIN_DEPTH:
            continue
        x = R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]
        y = R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]
        u, v = x / z * fx + cx, y / z * fy + cy
        if u >= border and u < w - 1 - border and v >= border and v < h - 1 - border:
            i, j = int(u), int(v)
            a, b = np.float32(u - i), np.float32(v - j)
            top = confidence[j, i] + a * (confidence[j, i + 1] - confidence[j, i])
            low = confidence[j + 1, i] + a * (confidence[j + 1, i + 1] - confidence[j + 1, i])
            anchor[n] = k
            rows[n, 0], rows[n, 1], rows[n, 2], rows[n, 3], rows[n, 4] = x, y, z, u, v
            rows[n, 5] = top + b * (low - top)
            n += 1
    return n


@njit(**JIT)
def _differentiate(points, t, focal, out):  # type: ignore[no-untyped-def]
    fx, fy = focal
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], max(points[k, 2], MIN_DEPTH)
        a, b, c, d = fx / z, -fx * x / z**2, fy / z, -fy * y / z**2
        p, q, r = x - t[0], y - t[1], points[k, 2] - t[2]
        out[k, 0, 0], out[k, 0, 2], out[k, 1, 1], out[k, 1, 2] = a, b, c, d
        out[k, 0, 3], out[k, 0, 4], out[k, 0, 5] = b * q, a * r - b * p, -a * q
        out[k, 1, 3], out[k, 1, 4], out[k, 1, 5] = d * q - c * r, -d * p, c * p


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
