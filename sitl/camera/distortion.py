"""Lens distortion and rolling shutter: an ideal pinhole image is rendered and then warped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.types import Float32, Image

_ROWS_APART = 16
_ROLLING_MARGIN_PX = 8.0  # rows that are exposed before and after look past the frame


@dataclass(frozen=True)
class RenderedLens:
    """A distorted `camera` and the `pinhole` to render for it; they share the optical centre.

    rays: (H, W, 2) float32, x / z and y / z of every pixel. maps: fixed-point maps for
    ``cv2.remap`` from the pinhole's image to the camera's.
    """

    camera: Camera
    pinhole: Camera
    rays: Float32
    maps: tuple[NDArray[np.int16], NDArray[np.uint16]]

    @classmethod
    def of(cls, camera: Camera, supersample: float = 1.0, is_rolling: bool = False) -> RenderedLens:
        """Choose the smallest pinhole camera that covers all rays of `camera`. supersample:
        resolution factor. is_rolling: adds a margin for the rolling shutter.
        """
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = camera.rays(np.stack([u, v], axis=-1) + 0.5)
        fx, fy = supersample * camera.fx, supersample * camera.fy
        x, y = rays[..., 0] * fx, rays[..., 1] * fy
        # One more pixel all around, for the bilinear look-up at the borders.
        margin = 1 + (supersample * _ROLLING_MARGIN_PX if is_rolling else 0)
        left, right = np.floor(x.min()) - margin, np.ceil(x.max()) + margin
        top, bottom = np.floor(y.min()) - margin, np.ceil(y.max()) + margin
        size = int(right - left), int(bottom - top)
        pinhole = Camera(*size, fx, fy, -float(left), -float(top))
        # OpenCV counts from the first pixel's centre.
        source = np.stack([x - left - 0.5, y - top - 0.5], axis=-1).astype(np.float32)
        coordinates, weights = cv2.convertMaps(source, None, cv2.CV_16SC2)
        flat = rays[..., :2].astype(np.float32)
        return cls(camera, pinhole, flat, (coordinates.astype(np.int16), weights.astype(np.uint16)))

    def distort(self, image: Image) -> Image:
        """Warp an image (H, W, 3) of the pinhole to the distorted camera."""
        return np.asarray(cv2.remap(image, *self.maps, cv2.INTER_LINEAR))

    def distort_depth(self, depth: Float32) -> Float32:
        """Warp a depth image (H, W) of the pinhole to the distorted camera (nearest neighbour)."""
        return np.asarray(cv2.remap(depth, self.maps[0], None, cv2.INTER_NEAREST))

    def roll(self, image: Image, depth: Float32, middle_from_row: Array) -> tuple[Image, Float32]:
        """Warp image and depth of the pinhole for lens distortion and rolling shutter.

        middle_from_row: (H, 3, 4), see `row_motion`. The depth gets the lens distortion only: the
        motion during a readout is a few pixels, so only silhouettes have an error.
        """
        still = self.distort_depth(depth)
        p = self.pinhole
        intrinsics = np.array([p.fx, p.fy, p.cx, p.cy], np.float32)
        source = np.empty((*still.shape, 2), np.float32)
        _row_maps(self.rays, still, np.float32(middle_from_row), intrinsics, source)
        edge = cv2.BORDER_REPLICATE
        bent = cv2.remap(image, source, None, cv2.INTER_LINEAR, None, edge)
        return np.asarray(bent), still


def row_motion(middle: Pose, pose_of_row: Callable[[float], Pose], height: int) -> Array:
    """Rigid transforms (H, 3, 4) from the camera at each row's exposure time to the camera at the
    middle row's, for a rolling shutter.

    pose_of_row: world_from_camera of a row; called for every few rows and interpolated.
    """
    rows = np.arange(height)
    known = np.append(np.arange(0, height - 1, _ROWS_APART), height - 1)
    motion = np.stack([(middle.inverse @ pose_of_row(float(row))).matrix[:3] for row in known])
    flat = motion.reshape(len(known), 12)
    each = [np.interp(rows, known, flat[:, k]) for k in range(12)]
    return np.stack(each, axis=1).reshape(height, 3, 4)


@njit(cache=True, nogil=True, fastmath=True)
def _row_maps(rays, depth, motion, intrinsics, out):  # type: ignore[no-untyped-def]
    """Write to `out` (H, W, 2) where ``cv2.remap`` looks each pixel up in the pinhole's image."""
    half, far = np.float32(0.5), np.float32(1e4)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for v in range(depth.shape[0]):
        m = motion[v]
        for u in range(depth.shape[1]):
            d = depth[v, u]
            if d <= 0:
                d = far
            x, y = rays[v, u, 0] * d, rays[v, u, 1] * d
            px = m[0, 0] * x + m[0, 1] * y + m[0, 2] * d + m[0, 3]
            py = m[1, 0] * x + m[1, 1] * y + m[1, 2] * d + m[1, 3]
            pz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * d + m[2, 3]
            out[v, u, 0] = px / pz * fx + cx - half
            out[v, u, 1] = py / pz * fy + cy - half
