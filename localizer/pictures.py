"""Image files, read and written through Python: OpenCV ends the process at a path not in UTF-8."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from localizer.errors import SequenceError
from localizer.types import Image


def read_rgb(path: Path) -> Image:
    """RGB image (H, W, 3) of a file, turned as its EXIF data say; `SequenceError` if it is none."""
    try:
        bgr = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    except (OSError, cv2.error) as error:
        raise SequenceError(f"{path}: cannot be read: {error}") from error
    if bgr is None:
        raise SequenceError(f"{path}: not an image, or damaged")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def write_rgb(path: Path, rgb: Image, jpeg_quality: int = 95) -> None:
    """Write an RGB image (H, W, 3) as PNG or JPEG, by suffix."""
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if path.suffix == ".jpg" else []
    _, coded = cv2.imencode(path.suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    path.write_bytes(coded.tobytes())
