"""Gradient features (soft orientation histograms) for use without a network."""

from __future__ import annotations

import cv2
import numpy as np

from localizer.features.image import check_image
from localizer.types import FeatureLevel, FeaturePyramid, Float32, Image

_ORIENTATIONS = 7
_STRIDES = (8, 4, 2)


class GradientExtractor:
    """Orientation energy at three scales, independent of the contrast's sign and locally
    normalised.

    C = 8: seven orientation bins, and one channel that is large where the image is flat. Because of
    this channel, normalisation to unit length does not amplify sensor noise.
    """

    name = "gradient (fallback: no model file)"

    def extract(self, rgb: Image) -> FeaturePyramid:
        """Pyramid of an (H, W, 3) uint8 RGB image, H and W divisible by 8."""
        check_image(rgb, _STRIDES[0])
        gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
        levels = tuple(_level(gray, stride) for stride in _STRIDES)
        return FeaturePyramid(levels, rgb.shape[1], rgb.shape[0])


def _level(gray: Float32, stride: int) -> FeatureLevel:
    h, w = gray.shape[0] // stride, gray.shape[1] // stride
    smooth = cv2.GaussianBlur(gray, (0, 0), 0.6 * stride)
    small = cv2.resize(smooth, (w, h), interpolation=cv2.INTER_AREA)
    gx = cv2.Sobel(small, cv2.CV_32F, 1, 0)
    gy = cv2.Sobel(small, cv2.CV_32F, 0, 1)
    magnitude, angle = cv2.cartToPolar(gx, gy)
    bins = np.empty((h, w, _ORIENTATIONS + 1), np.float32)
    for k in range(_ORIENTATIONS):
        response = np.maximum(np.cos(2.0 * (angle - np.pi * k / _ORIENTATIONS)), 0.0) ** 2
        bins[..., k] = cv2.GaussianBlur(magnitude * response, (0, 0), 1.0)
    energy = np.sqrt((bins[..., :-1] ** 2).sum(-1))
    # What counts as flat is relative to the neighbourhood and never below sensor noise.
    flat = 0.3 * np.sqrt(cv2.GaussianBlur(energy**2, (0, 0), 6.0)) + 0.01
    bins[..., -1] = flat
    norm = np.sqrt(energy**2 + flat**2)
    confidence = (energy / (energy + flat)).clip(1e-3, 1 - 1e-3).astype(np.float32)
    return FeatureLevel(np.ascontiguousarray(bins / norm[..., None]), confidence, stride)
