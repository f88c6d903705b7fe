"""A curriculum over the width of the pictures: the same pair as a narrow or a wide one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from localizer.training.data.pairs import Pair
from localizer.types import Float32, Image


@dataclass(frozen=True)
class Size:
    """Pictures brought to `width` pixels, of which windows of `crop` (width, height) are cut,
    `batch` pairs a step; drawn from `first_step` on.
    """

    first_step: int
    width: int
    crop: tuple[int, int]
    batch: int


def draw_size(step: int, sizes: Sequence[Size], rng: np.random.Generator) -> Size | None:
    """The size of a step, each that has begun as often as the others; None without sizes."""
    begun = [size for size in sizes if size.first_step <= step]
    return begun[int(rng.integers(len(begun)))] if begun else None


def resized(pair: Pair, width: int) -> Pair:
    """The pair as a camera of `width` pixels with the same field of view sees it."""
    if width == pair.camera.width:
        return pair
    size = (width, round(pair.camera.height * width / pair.camera.width))
    return replace(
        pair,
        reference=_averaged(pair.reference, size),
        reference_depth=_nearest(pair.reference_depth, size),
        query=_averaged(pair.query, size),
        query_depth=_nearest(pair.query_depth, size),
        camera=pair.camera.resized(*size),
    )


def _averaged(image: Image, size: tuple[int, int]) -> Image:
    small: Image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return small


def _nearest(depth: Float32, size: tuple[int, int]) -> Float32:
    """No mean of depths: between two surfaces nothing is."""
    small: Float32 = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
    return small
