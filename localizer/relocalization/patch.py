"""Rectifies a frame onto the horizontal ground plane, to compare it with the map from above."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array
from localizer.types import Image

_MULTIPLE = 32  # px: sides of patches, so that few sizes occur
_BORDER_PX = 2  # of the image, where resampling has one side only
FARTHEST = 2.0  # of the ground that is used, in heights: what is farther is seen too flat
_EDGE_RAYS = 9  # per side of the image, to outline what is seen


@dataclass(frozen=True)
class CameraFootprint:
    """The ground that a camera sees at heading 0, relative to the point below it.

    centre: (2,) m; side_m: side of a square about it that contains the footprint at every heading.
    """

    centre: Array
    side_m: float


@dataclass(frozen=True)
class Patch:
    """A square of ground, north up. rgb: (n, n, 3) uint8; seen: (n, n) mask of the frame's pixels;
    centre: (2,) m from the point below the camera.
    """

    rgb: Image
    seen: NDArray[np.bool_]
    centre: Array


def with_heading(rotation: Array, heading_rad: float) -> Array:
    """A rotation (3, 3) world_from_camera, rotated about up by heading_rad, counter-clockwise."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    result: Array = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation
    return result


def footprint(
    camera: Camera, rotation: Array, height_m: float, largest_m: float
) -> CameraFootprint:
    """The useful ground seen by a camera `height_m` above flat ground. rotation: (3, 3)
    world_from_camera; largest_m: limit of its side.
    """
    u = np.linspace(0, camera.width, _EDGE_RAYS)
    v = np.linspace(0, camera.height, _EDGE_RAYS)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = camera.rays(grid) @ rotation.T
    flat = np.linalg.norm(rays[:, :2], axis=1)
    down = np.maximum(-rays[:, 2], 1e-9)
    reach = np.minimum(flat / down, FARTHEST)
    points = height_m * reach[:, None] * rays[:, :2] / np.maximum(flat, 1e-9)[:, None]
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    if 2 * radius > largest_m:
        # What is near is seen best: the square lies about the footprint's near part.
        axis = camera.rays(np.array([camera.width / 2, camera.height / 2])) @ rotation.T
        along = axis[:2] / max(-axis[2], 0.35 * float(np.linalg.norm(axis)))
        length = float(np.linalg.norm(along))
        centre = height_m * along * min(1.0, 1.6 / max(length, 1e-9))
        radius = float(np.linalg.norm(points - centre, axis=1).max())
    return CameraFootprint(centre, min(2 * radius, largest_m))


def patch_side(side_m: float, gsd_m: float, most_px: int) -> int:
    """Pixels of a patch's side: a multiple of `_MULTIPLE`, at most most_px."""
    return int(min(-(-side_m / gsd_m // _MULTIPLE) * _MULTIPLE, most_px))


def rectify(
    image: Image,
    camera: Camera,
    rotation: Array,
    height_m: float,
    centre: Array,
    side_px: int,
    gsd_m: float,
) -> Patch:
    """Rectify a pinhole image (H, W, 3) to the square of ground about `centre` (2,), m east and
    north of the point below the camera; row 0 is in the north. A fourth channel of the image is 255
    where it shows the ground.

    rotation: (3, 3) world_from_camera; height_m: above the ground, which is assumed to be flat.
    Ground outside the image gets the image's mean colour.
    """
    a = (np.arange(side_px) + 0.5 - side_px / 2) * gsd_m
    # A plane's image is a homography: rows east, north, 1 of the ground's coordinates.
    east, north = (centre[0] + a).astype(np.float32), (centre[1] - a).astype(np.float32)
    R = rotation.astype(np.float32)
    x, y, z = (
        R[0, k] * east[None, :] + (R[1, k] * north - R[2, k] * np.float32(height_m))[:, None]
        for k in range(3)
    )
    front = z > 1.0
    inverse = 1.0 / np.where(front, z, 1.0)
    u = np.float32(camera.fx) * x * inverse + np.float32(camera.cx)
    v = np.float32(camera.fy) * y * inverse + np.float32(camera.cy)
    seen = front & (u > _BORDER_PX) & (u < camera.width - _BORDER_PX)
    seen &= (v > _BORDER_PX) & (v < camera.height - _BORDER_PX)
    half = np.float32(0.5)
    rgb = cv2.remap(image, u - half, v - half, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if image.shape[2] == 4:
        rgb, seen = rgb[..., :3], seen & (rgb[..., 3] == 255)
    mean = np.asarray(cv2.mean(image)[:3])
    rgb[~seen] = np.rint(mean).astype(np.uint8)
    return Patch(rgb.astype(np.uint8, copy=False), seen, centre)
