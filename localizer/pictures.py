"""Reads and writes image files through Python, because OpenCV crashes for a path not in UTF-8.
Shrinks images.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.errors import GreyRangeError, SequenceError
from localizer.types import Image

GreyRange = tuple[int, int]  # counts of a 16-bit grey picture that become black and white
_COUNTS = 1 << 16


def read_rgb(path: Path) -> Image:
    """RGB image (H, W, 3) of a file, rotated by its EXIF data. `SequenceError` if it cannot be
    read, is no image, or is 16-bit grey, whose range is unknown here.
    """
    try:
        rgb = decode_rgb(path.read_bytes())
    except GreyRangeError as error:
        raise SequenceError(f"{path}: {error}; write it with 8 bits") from error
    except (OSError, cv2.error) as error:
        raise SequenceError(f"{path}: cannot be read: {error}") from error
    if rgb is None:
        raise SequenceError(f"{path}: not an image, or damaged")
    return rgb


def decode_rgb(
    data: bytes, *, turned: bool = True, grey_range: GreyRange | None = None
) -> Image | None:
    """RGB image (H, W, 3) of a file's content, grey ones with three equal channels; None if it is
    no image, or of colours that have not 8 or 16 bits; cv2.error if `data` is empty. turned: rotate
    it by its EXIF data. Colours of 16 bits lose the lower 8. grey_range, for 16-bit grey only, and
    its errors: see `grey_levels`.
    """
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
    if not turned:
        flags |= cv2.IMREAD_IGNORE_ORIENTATION
    found: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if found is None:
        return None
    if found.ndim == 2:
        grey = found if found.dtype == np.uint8 else grey_levels(found, grey_range)
        return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.uint8)
    if found.dtype == np.uint16:  # colour of 16 bits fills them
        found = (found >> 8).astype(np.uint8)
    if found.dtype != np.uint8:
        return None
    return np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2RGB), np.uint8)


def grey_levels(counts: NDArray[Any], grey_range: GreyRange | None) -> Image:
    """(H, W) uint8 of a sensor's counts (H, W) uint16, linear between the two counts of
    `grey_range` (black, white); counts beyond them are black or white.

    A thermal camera uses a few thousand of the 65,536 counts: the upper bits alone would give some
    ten levels of grey. `GreyRangeError` if the range is None or the counts are not uint16.
    """
    if counts.dtype != np.uint16:
        raise GreyRangeError(f"grey of {counts.dtype} counts; 8 or 16 bits without sign are read")
    if grey_range is None:
        raise GreyRangeError(
            f"16-bit grey, here {counts.min()} to {counts.max()}, without a range: which counts "
            "are black and white is not said"
        )
    return np.asarray(_table(grey_range)[counts], np.uint8)


@lru_cache(maxsize=4)
def _table(grey_range: GreyRange) -> Image:
    low, high = grey_range
    share = (np.arange(_COUNTS, dtype=np.float32) - low) / np.float32(high - low)
    return np.asarray(np.clip(share, 0.0, 1.0) * 255.0 + 0.5, np.uint8)


def shrink(image: Image, size: tuple[int, int], halved_from: int = 4) -> Image:
    """The image (H, W, 3), averaged over areas, at a smaller size (width, height). OpenCV averages
    whole numbers of pixels ten times as fast as others, two the fastest: an image of `halved_from`
    times the size is halved first.
    """
    while image.shape[1] >= halved_from * size[0] and image.shape[0] >= halved_from * size[1]:
        image = _averaged(image, (image.shape[1] // 2, image.shape[0] // 2))
    return image if image.shape[1::-1] == size else _averaged(image, size)


def _averaged(image: Image, size: tuple[int, int]) -> Image:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def write_rgb(path: Path, rgb: Image, jpeg_quality: int = 95) -> None:
    """Write an RGB image (H, W, 3) as PNG or JPEG, by suffix, into an existing folder.
    jpeg_quality: 0 to 100, for the suffix .jpg only.
    """
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if path.suffix == ".jpg" else []
    _, coded = cv2.imencode(path.suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    path.write_bytes(coded.tobytes())
