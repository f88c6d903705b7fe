"""Which pictures are refused, and that poor but usable ones are not."""

import cv2
import numpy as np
import pytest

from localizer.odometry.usability import ImageFault, examine

SIZE = (240, 320, 3)


def ground_picture(seed: int = 0) -> np.ndarray:
    """Texture on all scales, as the ground has it, with a camera's noise."""
    rng = np.random.default_rng(seed)
    total = np.zeros(SIZE[:2], np.float32)
    for cells in (4, 10, 25, 60, 120):
        field = rng.standard_normal((cells * 3 // 4, cells)).astype(np.float32)
        total += cv2.resize(field, (SIZE[1], SIZE[0]), interpolation=cv2.INTER_CUBIC)
    grey = 110 + 18 * total
    noisy = grey[..., None] + rng.normal(0, 2, SIZE)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def in_fog(image: np.ndarray, visible: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    hazy = image * visible + 205 * (1 - visible) + rng.normal(0, 1.5, image.shape)
    return np.clip(hazy, 0, 255).astype(np.uint8)


def covered(grey: float) -> np.ndarray:
    """A hand over the lens: a smooth gradient with noise."""
    rng = np.random.default_rng(2)
    ramp = grey + 0.1 * np.arange(SIZE[1])[None, :, None]
    return np.clip(ramp + rng.normal(0, 3, SIZE), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("picture", "fault"),
    [
        (covered(3.0) // 12, ImageFault.BLACK),
        (covered(40.0), ImageFault.FLAT),
        (in_fog(ground_picture(), 0.01), ImageFault.FLAT),
        (np.full(SIZE, 255, np.uint8), ImageFault.SATURATED),
        (cv2.GaussianBlur(ground_picture(), (0, 0), 6), ImageFault.BLURRED),
        (cv2.blur(ground_picture(), (41, 1)), ImageFault.BLURRED),
        (cv2.blur(ground_picture(), (1, 41)), ImageFault.BLURRED),
    ],
)
def test_a_picture_without_use_is_refused_by_its_name(picture, fault):
    verdict = examine(picture)
    assert verdict.fault is fault
    assert not verdict.usable


@pytest.mark.parametrize(
    "picture",
    [
        ground_picture(),
        in_fog(ground_picture(), 0.25),
        cv2.GaussianBlur(ground_picture(), (0, 0), 1.0),
        cv2.blur(ground_picture(), (5, 1)),
        (ground_picture() * 0.15).astype(np.uint8),
        np.minimum(ground_picture().astype(int) + 90, 255).astype(np.uint8),
    ],
    ids=["clear", "fog", "defocus", "motion", "dusk", "bright"],
)
def test_a_poor_picture_is_not_refused(picture):
    assert examine(picture).fault is None


def test_a_repeated_picture_is_a_frozen_stream():
    picture = ground_picture()
    assert examine(picture, picture.copy()).fault is ImageFault.FROZEN
    assert examine(picture, ground_picture(1)).fault is None


def test_half_a_picture_is_enough():
    picture = ground_picture()
    picture[:120] = 128
    verdict = examine(picture)
    assert verdict.usable
    assert verdict.structured == pytest.approx(0.5, abs=0.05)
