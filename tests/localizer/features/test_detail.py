"""The detail level: invariant to light, exact in position."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from localizer.features.detail import DetailExtractor, detail_level
from localizer.features.gradient import GradientExtractor


@pytest.fixture(scope="module")
def image():
    rng = np.random.default_rng(0)
    noise = rng.uniform(60, 180, (60, 80, 3)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 2.0) * 3.0 - 240.0


def bytes_of(values):
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def test_it_is_the_last_level_of_the_pyramid(image):
    pyramid = DetailExtractor(GradientExtractor()).extract(bytes_of(image)[:56])
    assert [level.stride for level in pyramid.levels] == [8, 4, 2, 1]
    detail = pyramid.levels[-1]
    assert detail.features.shape == (56, 80, 4)
    assert detail.features.dtype == detail.confidence.dtype == np.float32
    assert detail.features.flags.c_contiguous
    assert 0 < detail.confidence.min() <= detail.confidence.max() < 1


def test_exposure_and_contrast_cancel(image):
    bright, dim = detail_level(bytes_of(image)), detail_level(bytes_of(0.6 * image + 30))
    inside = (slice(12, -12), slice(12, -12))
    difference = np.abs(bright.features - dim.features)[inside]
    assert np.median(difference) < 0.1 * bright.features[inside].std()


def test_it_moves_with_the_image(image):
    moved = detail_level(bytes_of(np.roll(image, (3, -5), (0, 1)))).features
    inside = (slice(20, -20), slice(20, -20))
    still = np.roll(detail_level(bytes_of(image)).features, (3, -5), (0, 1))
    np.testing.assert_allclose(moved[inside], still[inside], atol=2e-3)


def test_a_flat_image_has_no_confidence_and_no_structure():
    level = detail_level(np.full((40, 40, 3), 128, np.uint8))
    assert np.abs(level.features).max() < 1e-3
    assert level.confidence.max() < 0.5
