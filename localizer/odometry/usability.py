"""Checks whether an image can be registered at all, before features are computed.

It uses the image alone: covered lens, cloud, night without gain, sun in the lens, motion blur, or a
repeated frame.
"""

from __future__ import annotations

from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.types import Float32, Image

_WIDTH = 160  # px; what is judged is averaged down to it, which leaves structure and not noise
_BLOCK = 10  # px of that size


class ImageFault(Enum):
    """Why a frame is not usable."""

    BLACK = "the picture is black"
    SATURATED = "the picture is saturated"
    FLAT = "the picture shows no structure"
    BLURRED = "the picture is blurred"
    FROZEN = "the stream repeats one picture"


# Grey values are of 255, shares of the picture's area.
_BLACK, _WHITE = 6.0, 250.0  # what counts as black, as saturated
_MOST_LOST = 0.9  # share of black or saturated area
_STRUCTURE = 1.5  # contrast of a block that shows something
_LEAST_STRUCTURED = 0.2  # share of the area that must show something
_LEAST_SHARPNESS = 0.06  # fine over coarse contrast of a sharp picture


def find_fault(image: Image, previous: Image | None = None) -> ImageFault | None:
    """Check an image (H, W, 3) uint8 RGB; None if it can be registered. previous: the stream's
    image before it; None: it is not tested for a frozen video.

    Takes a fraction of a millisecond at the working size.
    """
    if previous is not None and np.array_equal(image, previous):
        return ImageFault.FROZEN
    grey = _shrunk(image)
    if np.mean(grey <= _BLACK) >= _MOST_LOST:
        return ImageFault.BLACK
    if np.mean(grey >= _WHITE) >= _MOST_LOST:
        return ImageFault.SATURATED
    seen = _block_contrast(grey) >= _STRUCTURE
    if np.mean(seen) < _LEAST_STRUCTURED:
        return ImageFault.FLAT
    return ImageFault.BLURRED if _sharpness(grey, seen) < _LEAST_SHARPNESS else None


def _shrunk(image: Image) -> Float32:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height = max(_BLOCK, round(_WIDTH * image.shape[0] / image.shape[1]))
    small = cv2.resize(grey, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    shrunk: Float32 = small.astype(np.float32)
    return shrunk


def _block_contrast(grey: Float32) -> Float32:
    """Standard deviation of each whole block of `_BLOCK` x `_BLOCK` pixels."""
    rows, columns = (n // _BLOCK for n in grey.shape)
    blocks = grey[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    return np.asarray(blocks.std(axis=(1, 3)), np.float32)


def _sharpness(grey: Float32, seen: NDArray[np.bool_]) -> float:
    """Contrast that an average over three pixels removes, divided by the contrast, in the visible
    blocks.

    It is measured along rows and along columns, and the smaller value counts, because motion blurs
    in one direction.
    """
    whole = _block_contrast(grey)[seen]
    fine = [_block_contrast(grey - cv2.blur(grey, size))[seen] for size in ((3, 1), (1, 3))]
    return min(float(np.median(part / whole)) for part in fine)
