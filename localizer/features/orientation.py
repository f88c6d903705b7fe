"""Orientation energy at one scale: channels that nobody learned (soft orientation histograms).

Independent of the contrast's sign and locally normalised. Seven orientation bins, and one channel
that is large where the image is flat, so that normalisation to unit length does not amplify sensor
noise. `localizer.training.models.tiny` has the same function in torch. Compiled, it takes a
fifth of the time that a runtime for networks takes for its many small steps.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit

from localizer.registration.cpu.algebra import JIT
from localizer.types import FeatureLevel, Float32, Image

ORIENTATIONS = 7
CHANNELS = ORIENTATIONS + 1
_ANGLES = 2.0 * np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1).astype(np.float32)
_GRAY = np.array([0.299, 0.587, 0.114], np.float32) / np.float32(255)


def gray_of(rgb: Image) -> Float32:
    """Brightness (H, W), 0 to 1, of an (H, W, 3) uint8 RGB image."""
    gray = np.empty(rgb.shape[:2], np.float32)
    _weigh_colours(rgb.reshape(-1, 3), _GRAY, gray.reshape(-1))
    return gray


def orientation_level(gray: Float32, stride: int, learned: Float32 | None = None) -> FeatureLevel:
    """The level of a stride that divides the sides of the brightness (H, W). Borders are
    replicated.

    learned: (h, w, 1 + n) of a network: the logit of the orientation's share in the squared
    distance, and n features of any length, which follow the orientation's channels.
    """
    h, w = gray.shape[0] // stride, gray.shape[1] // stride
    if learned is not None and learned.shape[:2] != (h, w):
        raise ValueError(f"learned features {learned.shape} for a level of {h}x{w}")
    bins = np.empty((ORIENTATIONS, h, w), np.float32)
    _histogram(gray, stride, _reduction(stride), _BLUR, _DIRECTIONS, bins)
    if learned is None:
        share, learned = np.ones((h, w), np.float32), np.empty((h, w, 1), np.float32)
    else:
        share = 1.0 / (1.0 + np.exp(-learned[:, :, 0]))
    features = np.empty((h, w, CHANNELS + learned.shape[2] - 1), np.float32)
    confidence = np.empty((h, w), np.float32)
    _normalise(bins, _SURROUND, share, learned, features, confidence)
    return FeatureLevel(features, confidence, stride)


def _gaussian(sigma: float) -> Float32:
    """Normalised samples out to four sigma."""
    radius = (round(8 * sigma + 1) | 1) // 2
    x = np.arange(-radius, radius + 1)
    kernel = np.exp(-(x**2) / (2 * sigma**2))
    return np.asarray(kernel / kernel.sum(), np.float32)


def _even(taps: Float32) -> Float32:
    """Symmetric taps with an even number of pairs, by two zeros."""
    return np.pad(taps, len(taps) // 2 % 2).astype(np.float32)


@cache
def _reduction(stride: int) -> Float32:
    """The filter before one pixel in `stride` is taken: smoothed, and averaged over the area."""
    area = np.full(stride, np.float32(1 / stride))
    return _even(np.convolve(_gaussian(0.6 * stride), area))


_BLUR, _SURROUND = _even(_gaussian(1.0)), _even(_gaussian(6.0))


@njit(**JIT)
def _weigh_colours(rgb, weights, gray):  # type: ignore[no-untyped-def]
    a, b, c = weights
    for k in range(len(gray)):
        gray[k] = a * rgb[k, 0] + b * rgb[k, 1] + c * rgb[k, 2]


@njit(**JIT)
def _add_pairs(taps, k, a, b, c, d, out):  # type: ignore[no-untyped-def]
    """Two pairs of symmetric taps at once: half the loads and stores."""
    s, t = taps[k], taps[k + 1]
    for x in range(len(out)):
        out[x] += s * (a[x] + b[x]) + t * (c[x] + d[x])


@njit(**JIT)
def _filter(values, taps, stride, out):  # type: ignore[no-untyped-def]
    """Filter along both axes, sampled every `stride` pixels, borders replicated. taps: of
    `_even`.
    """
    height, width = values.shape
    h, w = out.shape
    size = len(taps)
    half, before = size // 2, (size - stride) // 2
    line = np.empty(width + size, np.float32)
    phases = np.empty((stride, (width + size) // stride), np.float32)
    for y in range(h):
        row, first = line[before : before + width], y * stride - before
        if size % 2:
            row[:] = taps[half] * values[min(max(first + half, 0), height - 1)]
        else:
            row[:] = 0
        for k in range(0, half, 2):
            a, b = min(max(first + k, 0), height - 1), min(max(first + k + 1, 0), height - 1)
            c = min(max(first + size - 1 - k, 0), height - 1)
            d = min(max(first + size - 2 - k, 0), height - 1)
            _add_pairs(taps, k, values[a], values[c], values[b], values[d], row)
        line[:before], line[before + width :] = row[0], row[width - 1]
        for p in range(stride):
            phase = phases[p]
            for x in range(len(phase)):
                phase[x] = line[x * stride + p]
        target = out[y]
        if size % 2:
            target[:] = taps[half] * phases[half % stride, half // stride :][:w]
        else:
            target[:] = 0
        for k in range(0, half, 2):
            m, n = size - 1 - k, size - 2 - k
            _add_pairs(
                taps, k, phases[k % stride, k // stride :], phases[m % stride, m // stride :],
                phases[(k + 1) % stride, (k + 1) // stride :], phases[n % stride, n // stride :],
                target,
            )  # fmt: skip


@njit(**JIT)
def _histogram(gray, stride, reduction, blur, directions, bins):  # type: ignore[no-untyped-def]
    h, w = bins.shape[1:]
    small, response = np.empty((h, w), np.float32), np.empty(bins.shape, np.float32)
    magnitude, double_x, double_y = np.empty((3, w), np.float32)
    _filter(gray, reduction, stride, small)
    least, two, one, zero = np.float32(1e-12), np.float32(2), np.float32(1), np.float32(0)
    padded = np.empty((3, w + 2), np.float32)
    for y in range(h):
        for k in range(3):
            row = small[min(max(y + k - 1, 0), h - 1)]
            padded[k, 1 : w + 1] = row
            padded[k, 0], padded[k, w + 1] = row[0], row[w - 1]
        above, here, below = padded[0], padded[1], padded[2]
        for x in range(w):
            gx = above[x + 2] - above[x] + two * (here[x + 2] - here[x]) + below[x + 2] - below[x]
            gy = below[x] - above[x] + two * (below[x + 1] - above[x + 1]) + below[x + 2]
            gy -= above[x + 2]
            square = gx * gx + gy * gy + least
            magnitude[x] = np.sqrt(square)
            inverse = one / square
            double_x[x], double_y[x] = (gx * gx - gy * gy) * inverse, two * gx * gy * inverse
        for k in range(ORIENTATIONS):
            a, b, row = directions[k, 0], directions[k, 1], response[k, y]
            for x in range(w):
                along = max(a * double_x[x] + b * double_y[x], zero)
                row[x] = along * along * magnitude[x]
    for k in range(ORIENTATIONS):
        _filter(response[k], blur, 1, bins[k])


@njit(**JIT)
def _normalise(bins, surround, share, learned, features, confidence):  # type: ignore[no-untyped-def]
    h, w = confidence.shape
    extra = learned.shape[2] - 1
    energy2, around = np.zeros((h, w), np.float32), np.empty((h, w), np.float32)
    for k in range(ORIENTATIONS):
        for y in range(h):
            for x in range(w):
                energy2[y, x] += bins[k, y, x] * bins[k, y, x]
    _filter(energy2, surround, 1, around)
    relative, floor, one = np.float32(0.3), np.float32(0.01), np.float32(1)
    fixed, rest = np.empty((2, w), np.float32)
    for y in range(h):
        for x in range(w):
            # What counts as flat is relative to the neighbourhood and never below sensor noise.
            flat = relative * np.sqrt(around[y, x]) + floor
            energy = np.sqrt(energy2[y, x])
            confidence[y, x] = energy / (energy + flat)
            fixed[x] = np.sqrt(share[y, x] / (energy2[y, x] + flat * flat))
            rest[x] = one - share[y, x]
            around[y, x] = flat
        for x in range(w):
            for k in range(ORIENTATIONS):
                features[y, x, k] = bins[k, y, x] * fixed[x]
            features[y, x, ORIENTATIONS] = around[y, x] * fixed[x]
            raw, out = learned[y, x, 1:], features[y, x, CHANNELS:]
            squares = np.float32(1e-8)
            for k in range(extra):
                squares += raw[k] * raw[k]
            scale = np.sqrt(rest[x] / squares)
            for k in range(extra):
                out[k] = scale * raw[k]
