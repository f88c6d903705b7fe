"""Checks an extractor's input."""

from __future__ import annotations

import numpy as np

from localizer.errors import ModelError
from localizer.types import Image


def check_image(rgb: Image, multiple: int) -> None:
    """Raise `ModelError` unless `rgb` is (H, W, 3) uint8 with sides divisible by `multiple`."""
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ModelError(f"image must be (H, W, 3) uint8 RGB, got {rgb.shape} {rgb.dtype}")
    if rgb.shape[0] % multiple or rgb.shape[1] % multiple or 0 in rgb.shape:
        raise ModelError(
            f"image sides must be divisible by {multiple}, got {rgb.shape[1]}x{rgb.shape[0]}"
        )
