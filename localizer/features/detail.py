"""The finest feature level, which improves the registered pose from half a network cell to 0.1
pixel.

A network's levels have a stride of 2 or more. This one is the image at full resolution: brightness
and its two derivatives, divided by the local contrast to remove light, exposure and haze.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from localizer.features.extractor import FeatureExtractor
from localizer.types import FeatureLevel, FeaturePyramid, Float32, Image

_SMOOTH_PX = 0.8  # a rendered texture and a photo differ in their last half pixel
_HALF_CONTRAST_PX = 2.45  # sigma of the contrast's window at half the resolution: 5 px, resized
_CONTRAST_FLOOR = 0.01  # of full brightness: below it is sensor noise
_CONFIDENT_CONTRAST = 0.02  # contrast that counts half
_BRIGHTNESS_SHARE = 0.3  # of brightness against derivatives: light changes it more


class DetailExtractor:
    """Another extractor's pyramid with the detail level appended."""

    def __init__(self, base: FeatureExtractor) -> None:
        self._base = base

    @property
    def name(self) -> str:
        """What computes the features, for reports."""
        return f"{self._base.name} + detail"

    def extract(self, rgb: Image) -> FeaturePyramid:
        """Pyramid of an (H, W, 3) uint8 RGB image; the last level has stride 1."""
        pyramid = self._base.extract(rgb)
        levels = (*pyramid.levels, detail_level(rgb))
        return FeaturePyramid(levels, pyramid.width, pyramid.height)


def detail_level(rgb: Image) -> FeatureLevel:
    """Contrast-normalised brightness and derivatives (H, W, 4) of an (H, W, 3) uint8 RGB image.

    The vectors do not have unit length. The fourth channel is zero, so that a pixel fills one SIMD
    register of four floats.
    """
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) * np.float32(1 / 255)
    smooth = cv2.GaussianBlur(gray, (0, 0), _SMOOTH_PX)
    mean, squares = _window_means(smooth), _window_means(smooth * smooth)
    dx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8)
    dy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    features = np.empty(4 * gray.size, np.float32)
    confidence = np.empty(gray.size, np.float32)
    planes = (plane.reshape(-1) for plane in (smooth, mean, squares, dx, dy))
    _normalise(*planes, features, confidence)
    return FeatureLevel(features.reshape(*gray.shape, 4), confidence.reshape(gray.shape), 1)


def _window_means(values: Float32) -> Float32:
    """Means in the contrast's window; smoothing at half the resolution takes a quarter the time."""
    height, width = values.shape
    half = cv2.resize(values, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(half, (0, 0), _HALF_CONTRAST_PX)
    means: Float32 = cv2.resize(smooth, (width, height)).astype(np.float32, copy=False)
    return means


@njit(cache=True, nogil=True, error_model="numpy")
def _normalise(smooth, mean, squares, dx, dy, features, confidence):  # type: ignore[no-untyped-def]
    """Brightness and derivatives, divided by the local contrast, and the confidence."""
    floor, half = np.float32(_CONTRAST_FLOOR), np.float32(_CONFIDENT_CONTRAST)
    share, zero = np.float32(_BRIGHTNESS_SHARE), np.float32(0)
    contrast = squares
    for k in range(len(smooth)):  # two loops: with more arrays in one, LLVM makes no SIMD
        contrast[k] = np.sqrt(max(squares[k] - mean[k] * mean[k], zero)) + floor
        confidence[k] = contrast[k] / (contrast[k] + half)
    for k in range(len(smooth)):
        features[4 * k] = share * (smooth[k] - mean[k]) / contrast[k]
        features[4 * k + 1] = dx[k] / contrast[k]
        features[4 * k + 2] = dy[k] / contrast[k]
        features[4 * k + 3] = zero
