"""Fills holes of the map in a rendered view."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.types import Image, RenderedView


def fill_holes(view: RenderedView) -> Image:
    """The view's image (H, W, 3) uint8 with the map's holes filled from their surroundings.

    The camera's frame has no such edges, and in the reference they would change all features near
    them. Pixels above the horizon are not filled, because the sky may be seen there. The method is
    "pull-push", averages from fine to coarse and back (Gortler et al., The Lumigraph, SIGGRAPH
    1996, section 3.4.3). Without any surface in view the image is unchanged.
    """
    known = view.depth > 0
    if known.all():
        return view.rgb
    holes = ~known & ~_above_horizon(view)
    if not holes.any() or not known.any():
        return view.rgb
    filled = _pull_push(view.rgb, known)
    return np.where(holes[..., None], filled, view.rgb)


def _above_horizon(view: RenderedView) -> NDArray[np.bool_]:
    """Mask (H, W) of the pixels whose ray leads upwards in the world (z up)."""
    camera, (right, down, ahead) = view.camera, view.world_from_camera.rotation[2]
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.asarray(right * x[None, :] + down * y[:, None] + ahead > 0)


def _pull_push(rgb: Image, known: NDArray[np.bool_]) -> Image:
    weights = [known.astype(np.float32)]
    colours = [rgb * weights[0][..., None]]  # premultiplied
    while weights[-1].size > 1:
        height, width = weights[-1].shape
        half = ((width + 1) // 2, (height + 1) // 2)
        weights.append(_resized(weights[-1], half, cv2.INTER_AREA))
        colours.append(_resized(colours[-1], half, cv2.INTER_AREA))
    filled = colours.pop() / weights.pop()[..., None]
    while weights:
        weight, colour = weights.pop(), colours.pop()
        behind = _resized(filled, weight.shape[::-1], cv2.INTER_LINEAR)
        filled = colour + (1 - weight[..., None]) * behind
    picture: NDArray[np.uint8] = np.rint(filled).clip(0, 255).astype(np.uint8)
    return picture


def _resized(image: NDArray[np.float32], size: tuple[int, ...], how: int) -> NDArray[np.float32]:
    shape = (size[1], size[0], *image.shape[2:])
    resized: NDArray[np.float32] = cv2.resize(image, size, interpolation=how).reshape(shape)
    return resized.astype(np.float32, copy=False)
