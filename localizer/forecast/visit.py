"""Simulates a camera's view of the map on another day, by changing a rendered view.

Geometry stays. Light, weather and sensor are `localizer.synth.appearance`'s, changes of the fine
texture `localizer.synth.visits.texture`'s. Moved shadows and map errors are not simulated;
`localizer.forecast.risk` is fitted on worlds that have both.
"""

from __future__ import annotations

import cv2
import numpy as np

from localizer.synth.appearance.model import CONDITIONS, weathered
from localizer.synth.visits.texture import hard_surfaces, with_new_texture
from localizer.types import Float32, Image, RenderedView

SEASON = "season"
FORECAST_CONDITIONS = (*CONDITIONS, SEASON)
_SOFT_PX = (0.4, 1.3)  # a map's texture is coarser than the picture
_CHANGED = (0.0, 0.06)  # share of the picture that shows something else by now
_CHANGE_M = 6.0  # side of such a place: a shed, a lorry, a felled tree
_DRY = np.array([1.12, 1.0, 0.8], np.float32)  # grass and leaves out of season, RGB factors
_LEAST_CELL_M = 0.02


def simulate_visit(view: RenderedView, condition: str, rng: np.random.Generator) -> Image:
    """A simulated image (H, W, 3) of `view` under one of `FORECAST_CONDITIONS`; ValueError for
    another condition.
    """
    surface = view.depth[view.depth > 0]
    if not surface.size:
        return view.rgb
    far_m = float(np.median(surface))
    cell_m = max(far_m / view.camera.fx, _LEAST_CELL_M)
    grown = _other_texture(view.rgb, cell_m, rng, condition == SEASON)
    image = _changed(grown, cell_m, rng)
    if rng.random() < 0.5:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(*_SOFT_PX)), np.uint8)
    return weathered(image, view.depth, "day" if condition == SEASON else condition, rng)


def _other_texture(rgb: Image, cell_m: float, rng: np.random.Generator, dry: bool) -> Image:
    """The image with another fine texture on soft ground; dry: also out of season."""
    height, width = rgb.shape[:2]
    side = max(height, width)
    square = cv2.copyMakeBorder(
        rgb, 0, side - height, 0, side - width, cv2.BORDER_REFLECT_101
    ).astype(np.uint8, copy=False)
    lasting = hard_surfaces(square)
    albedo: Float32 = square.astype(np.float32) / np.float32(255)
    if dry:
        share = np.float32(rng.uniform(0.3, 1.0)) * (1 - lasting)[..., None]
        albedo = albedo * (1 - share) + albedo.mean(axis=2, keepdims=True) * _DRY * share
    other = with_new_texture(albedo, lasting, cell_m, rng)[:height, :width]
    image: Image = np.clip(other * 255 + 0.5, 0, 255).astype(np.uint8)
    return image


def _changed(image: Image, cell_m: float, rng: np.random.Generator) -> Image:
    """The image with some regions replaced by other parts of it."""
    height, width = image.shape[:2]
    side = int(np.clip(_CHANGE_M / cell_m, 4, min(height, width) // 4))
    count = round(rng.uniform(*_CHANGED) * height * width / side**2)
    changed: Image = image.copy()
    for _ in range(count):
        (i, k), (j, m) = rng.integers(0, height - side, 2), rng.integers(0, width - side, 2)
        changed[i : i + side, j : j + side] = image[k : k + side, m : m + side]
    return changed
