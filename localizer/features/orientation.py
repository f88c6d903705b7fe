"""Orientation energy at one scale: channels that nobody learned (soft orientation histograms).

Independent of the contrast's sign and locally normalised. Seven orientation bins, and one channel
that is large where the image is flat, so that normalisation to unit length does not amplify sensor
noise. `localizer.training.models.orientation` has the same function in torch. Compiled, it takes a
fifth of the time that a runtime for networks takes for its many small steps.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
    extra = 0 if learned is None else learned.shape[2] - 1
    features = np.empty((h, w, CHANNELS + extra), np.float32)
    confidence = np.empty((h, w), np.float32)
    bins = np.empty((ORIENTATIONS, h, w), np.float32)
    _histogram(gray, stride, _reduction(stride), _gaussian(1.0), _DIRECTIONS, bins)
    _normalise(bins, _gaussian(6.0), features, confidence)
    if learned is not None:
        share = 1.0 / (1.0 + np.exp(-learned[:, :, 0]))
        _join(learned.reshape(h * w, -1), share.reshape(-1), features.reshape(h * w, -1))
    return FeatureLevel(features, confidence, stride)


def _gaussian(sigma: float) -> Float32:
    """Normalised samples out to four sigma."""
    radius = (round(8 * sigma + 1) | 1) // 2
    x = np.arange(-radius, radius + 1)
    kernel = np.exp(-(x**2) / (2 * sigma**2))
    return (kernel / kernel.sum()).astype(np.float32)


def _reduction(stride: int) -> Float32:
    """The filter before one pixel in `stride` is taken: smoothed, and averaged over the area."""
    area = np.full(stride, np.float32(1 / stride))
    return np.convolve(_gaussian(0.6 * stride), area).astype(np.float32)


@njit(**JIT)
def _weigh_colours(rgb, weights, gray):  # type: ignore[no-untyped-def]
    a, b, c = weights
    for k in range(len(gray)):
        gray[k] = a * rgb[k, 0] + b * rgb[k, 1] + c * rgb[k, 2]


@njit(**JIT)
def _filter(values, taps, stride, out):  # type: ignore[no-untyped-def]
    """Filter along both axes, sampled every `stride` pixels, borders replicated."""
    height, width = values.shape
    h, w = out.shape
    before = (len(taps) - stride) // 2
    line = np.empty(width + len(taps), np.float32)
    for y in range(h):
        row = line[before : before + width]
        row[:] = 0
        for k in range(len(taps)):
            source, tap = values[min(max(y * stride + k - before, 0), height - 1)], taps[k]
            for x in range(width):
                row[x] += tap * source[x]
        line[:before], line[before + width :] = row[0], row[width - 1]
        target = out[y]
        if stride == 1:
            target[:] = 0
            for k in range(len(taps)):
                tap = taps[k]
                for x in range(w):
                    target[x] += tap * line[x + k]
        else:
            for x in range(w):
                total = np.float32(0)
                for k in range(len(taps)):
                    total += taps[k] * line[x * stride + k]
                target[x] = total


@njit(**JIT)
def _histogram(gray, stride, reduction, blur, directions, bins):  # type: ignore[no-untyped-def]
    h, w = bins.shape[1:]
    small, response = np.empty((h, w), np.float32), np.empty(bins.shape, np.float32)
    magnitude, double_x, double_y = np.empty((3, w), np.float32)
    _filter(gray, reduction, stride, small)
    least, two, zero = np.float32(1e-12), np.float32(2), np.float32(0)
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
            double_x[x], double_y[x] = (gx * gx - gy * gy) / square, two * gx * gy / square
        for k in range(len(bins)):
            a, b, row = directions[k, 0], directions[k, 1], response[k, y]
            for x in range(w):
                along = max(a * double_x[x] + b * double_y[x], zero)
                row[x] = along * along * magnitude[x]
    for k in range(len(bins)):
        _filter(response[k], blur, 1, bins[k])


@njit(**JIT)
def _normalise(bins, surround, features, confidence):  # type: ignore[no-untyped-def]
    count, h, w = bins.shape
    energy2, around = np.zeros((h, w), np.float32), np.empty((h, w), np.float32)
    for k in range(count):
        for y in range(h):
            for x in range(w):
                energy2[y, x] += bins[k, y, x] * bins[k, y, x]
    _filter(energy2, surround, 1, around)
    share, floor, one = np.float32(0.3), np.float32(0.01), np.float32(1)
    inverse = np.empty(w, np.float32)
    for y in range(h):
        for x in range(w):
            # What counts as flat is relative to the neighbourhood and never below sensor noise.
            flat = share * np.sqrt(around[y, x]) + floor
            energy = np.sqrt(energy2[y, x])
            inverse[x] = one / np.sqrt(energy2[y, x] + flat * flat)
            confidence[y, x] = energy / (energy + flat)
            around[y, x] = flat
        for x in range(w):
            for k in range(count):
                features[y, x, k] = bins[k, y, x] * inverse[x]
            features[y, x, count] = around[y, x] * inverse[x]


@njit(**JIT)
def _join(learned, share, features):  # type: ignore[no-untyped-def]
    """Scale the orientation's channels by their share, and append the learned ones by the rest."""
    extra, one = learned.shape[1] - 1, np.float32(1)
    fixed = features.shape[1] - extra
    for i in range(len(learned)):
        kept, squares = np.sqrt(share[i]), np.float32(1e-8)
        for k in range(fixed):
            features[i, k] *= kept
        for k in range(extra):
            squares += learned[i, 1 + k] * learned[i, 1 + k]
        scale = np.sqrt((one - share[i]) / squares)
        for k in range(extra):
            features[i, fixed + k] = scale * learned[i, 1 + k]
