"""Refines a candidate position: correlates the frame's features with those of the map rendered
there.

The search assumes flat ground. High roofs displace its result by metres at low height, too far for
a registration. A rendering has the same parallax, so only an image shift remains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.types import FeatureLevel, Float32

_LEVEL = 1  # of the pyramid: stride 4. At 8 a shift of some metres is lost between cells
_LEAST_SHARED = 0.35  # of the image, under a shift
_LEAST_DOWN = 0.1  # of a ray, to meet the ground

Complex64 = NDArray[np.complex64]


@dataclass(frozen=True)
class ImageOffset:
    """Shift of a frame against a rendering. u, v: to the right and down, px; score: correlation
    there times the root of the common share, 0 to 1.
    """

    u: float
    v: float
    score: float


class FrameShift:
    """Estimates the shift of one frame against renderings of the same size, from features."""

    def __init__(self, levels: tuple[FeatureLevel, ...]) -> None:
        level = levels[_LEVEL]
        self._shape = level.features.shape[:2]
        self._stride = level.stride
        h, w = self._shape
        self._size = (scipy.fft.next_fast_len(2 * h, True), scipy.fft.next_fast_len(2 * w, True))
        features = _weighted(level)
        self._spectrum = self._transformed(features).conj()
        self._energy = self._transformed((features**2).sum(axis=2)).conj()
        self._ones = self._transformed(np.ones(self._shape, np.float32))
        seen = self._back(self._ones * self._ones.conj()) / (h * w)
        self._share = np.clip(seen, 0.0, 1.0)
        self._under = self._back(self._ones * self._energy)

    def estimate(self, levels: tuple[FeatureLevel, ...]) -> ImageOffset:
        """The best shift of the frame against a rendering. levels: its features."""
        features = _weighted(levels[_LEVEL])
        raw = self._back((self._transformed(features) * self._spectrum).sum(axis=2))
        energy = self._transformed((features**2).sum(axis=2))
        beside = self._back(energy * self._ones.conj())
        norm = np.sqrt(np.maximum(self._under, 1e-6) * np.maximum(beside, 1e-6))
        scores = np.where(self._share >= _LEAST_SHARED, raw / norm * np.sqrt(self._share), -1.0)
        i, j = (int(k) for k in np.unravel_index(int(scores.argmax()), scores.shape))
        v = i if i < self._shape[0] else i - self._size[0]
        u = j if j < self._shape[1] else j - self._size[1]
        return ImageOffset(float(u * self._stride), float(v * self._stride), float(scores[i, j]))

    def _transformed(self, values: Float32) -> Complex64:
        spectrum: Complex64 = scipy.fft.rfft2(values, self._size, axes=(0, 1), workers=1)
        return spectrum

    def _back(self, spectrum: Complex64) -> Float32:
        values: Float32 = scipy.fft.irfft2(spectrum, self._size, axes=(0, 1), workers=1)
        return values


def displacement(pose: Pose, camera: Camera, shift: ImageOffset, ground_m: float) -> Array:
    """Horizontal displacement (2,) m of the frame's camera from a rendering's pose, from their
    image shift, for equal heading and height. ground_m: ground height, world z. Zero if no ground
    is seen.
    """
    middle = np.array([camera.cx, camera.cy])
    rays = camera.rays(np.stack([middle, middle + np.array([shift.u, shift.v])])) @ pose.rotation.T
    if (rays[:, 2] > -_LEAST_DOWN * np.linalg.norm(rays, axis=1)).any():
        return np.zeros(2)
    places = rays[:, :2] * ((ground_m - pose.translation[2]) / rays[:, 2])[:, None]
    away: Array = places[1] - places[0]
    return away


def _weighted(level: FeatureLevel) -> Float32:
    """Features (H, W, C) minus their mean, weighted by confidence; the common mean indicates no
    shift.
    """
    weights = level.confidence.astype(np.float32)[..., None]
    features = level.features.astype(np.float32)
    mean = (features * weights).sum(axis=(0, 1)) / max(float(weights.sum()), 1e-9)
    return np.asarray((features - mean) * weights, np.float32)
