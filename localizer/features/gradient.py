"""Gradient features (soft orientation histograms) for use without a network."""

from __future__ import annotations

from localizer.features.image import check_image
from localizer.features.orientation import gray_of, orientation_level
from localizer.types import FeaturePyramid, Image

_STRIDES = (8, 4, 2)


class GradientExtractor:
    """Orientation energy at three scales, see `orientation`; C = 8."""

    name = "gradient (fallback: no model file)"

    def extract(self, rgb: Image) -> FeaturePyramid:
        """Pyramid of an (H, W, 3) uint8 RGB image, H and W divisible by 8."""
        check_image(rgb, _STRIDES[0])
        gray = gray_of(rgb)
        levels = tuple(orientation_level(gray, stride) for stride in _STRIDES)
        return FeaturePyramid(levels, rgb.shape[1], rgb.shape[0])
