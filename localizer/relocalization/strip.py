"""Lays the frames of the last seconds together: more ground than one frame shows, to compare more
coarsely. How far the camera moved is measured from frame to frame, by the shift of the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array
from localizer.relocalization.patch import CameraFootprint, footprint, rectify
from localizer.types import Float32, Image

_SIDE_PX = 256  # of two pictures whose shift is measured
_SOFT_PX = 5.0  # their edges, which do not move with the ground (sigma)
_LEAST_PX = 8  # of a strip's side, as of any camera
_LEAST_RESPONSE = 0.1  # of a shift that is one: the share of its peak


@dataclass(frozen=True)
class GroundView:
    """A pinhole image (H, W, 3). rotation: (3, 3) world_from_camera; height_m: above the ground."""

    image: Image
    camera: Camera
    rotation: Array
    height_m: float


@dataclass(frozen=True)
class GroundStrip:
    """A picture of the ground from above, north up, and its camera, which looks down from the
    newest view's position. image: (n, n, 4) uint8 RGB, and 255 where any view shows the ground;
    seen: at height 1 m.
    """

    image: Image
    camera: Camera
    seen: CameraFootprint


def lay_together(views: Sequence[GroundView], largest_m: float, gsd_m: float) -> GroundStrip | None:
    """A strip of the views, newest first, up to the first one that does not show its neighbour's
    ground, or for which it would be larger than `largest_m`; None if that leaves a few pixels.
    """
    height = views[0].height_m
    grounds = [footprint(v.camera, v.rotation, v.height_m, largest_m) for v in views]
    places = [np.zeros(2)]
    centre, side = grounds[0].centre, grounds[0].side_m
    for newer, older in pairwise(range(len(views))):
        way = _displacement([views[k] for k in (newer, older)], [grounds[newer], grounds[older]])
        if way is None:
            break
        about = np.array([*(p + g.centre for p, g in zip(places, grounds, strict=False)),
                          places[-1] + way + grounds[older].centre])  # fmt: skip
        reach = np.array([g.side_m for g in grounds[: older + 1]])[:, None] / 2
        middle = 0.5 * ((about - reach).min(axis=0) + (about + reach).max(axis=0))
        whole = 2 * float((np.linalg.norm(about - middle, axis=1) + reach[:, 0]).max())
        if whole > largest_m:
            break
        places.append(places[-1] + way)
        centre, side = middle, whole
    n = round(side / gsd_m)
    if n < _LEAST_PX:
        return None
    image = np.zeros((n, n, 4), np.uint8)
    for view, place in zip(views, places, strict=False):
        at = rectify(
            view.image, view.camera, view.rotation, view.height_m, centre - place, n, gsd_m
        )
        new = at.seen & (image[..., 3] == 0)
        image[new, :3], image[new, 3] = at.rgb[new], 255
    unseen = image[..., 3] == 0
    image[unseen, :3] = np.rint(image[~unseen, :3].mean(axis=0))
    focal = height / gsd_m
    camera = Camera(n, n, focal, focal, n / 2 - centre[0] / gsd_m, n / 2 + centre[1] / gsd_m)
    return GroundStrip(image, camera, CameraFootprint(centre / height, side / height))


def _displacement(views: Sequence[GroundView], grounds: Sequence[CameraFootprint]) -> Array | None:
    """How far (2,) the second camera is from the first, m; None if they see no common ground."""
    gsd_m = max(g.side_m for g in grounds) / _SIDE_PX
    first, second = (_picture(v, g.centre, gsd_m) for v, g in zip(views, grounds, strict=True))
    (east, south), response = cv2.phaseCorrelate(second, first)
    if not response >= _LEAST_RESPONSE:  # not a number where one of them is black
        return None
    moved: Array = np.array([east, -south]) * gsd_m + grounds[0].centre - grounds[1].centre
    return moved


def _picture(view: GroundView, centre: Array, gsd_m: float) -> Float32:
    """Ground in grey less its mean, (n, n), fading out where it is not seen."""
    at = rectify(view.image, view.camera, view.rotation, view.height_m, centre, _SIDE_PX, gsd_m)
    grey = cv2.cvtColor(at.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    inner = cv2.GaussianBlur(at.seen.astype(np.float32), (0, 0), _SOFT_PX)
    weight = np.maximum(2 * inner - 1, 0)
    mean = cv2.mean(grey, at.seen.astype(np.uint8))[0]  # 0 where nothing is seen
    return np.asarray((grey - mean) * weight, np.float32)
