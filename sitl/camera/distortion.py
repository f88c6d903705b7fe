"""Lens distortion for a renderer that draws ideal pinholes: render more, then bend."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.types import Float32, Image


@dataclass(frozen=True)
class Lens:
    """A distorted `camera` and the `pinhole` to render for it; they share the optical centre.

    maps: fixed-point look-up for ``cv2.remap``, from the pinhole's image to the camera's.
    """

    camera: Camera
    pinhole: Camera
    maps: tuple[NDArray[np.int16], NDArray[np.uint16]]

    @classmethod
    def of(cls, camera: Camera) -> Lens:
        """Chooses the smallest pinhole of the camera's scale that covers all its rays."""
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = camera.rays(np.stack([u, v], axis=-1) + 0.5)
        x, y = rays[..., 0] * camera.fx, rays[..., 1] * camera.fy
        # One more pixel all around, for the bilinear look-up at the borders.
        left, right = np.floor(x.min()) - 1, np.ceil(x.max()) + 1
        top, bottom = np.floor(y.min()) - 1, np.ceil(y.max()) + 1
        size = int(right - left), int(bottom - top)
        pinhole = Camera(*size, camera.fx, camera.fy, -float(left), -float(top))
        # OpenCV counts from the first pixel's centre.
        source = np.stack([x - left - 0.5, y - top - 0.5], axis=-1).astype(np.float32)
        coordinates, weights = cv2.convertMaps(source, None, cv2.CV_16SC2)
        return cls(camera, pinhole, (coordinates.astype(np.int16), weights.astype(np.uint16)))

    def distort(self, image: Image) -> Image:
        """The camera's image (H, W, 3) of the pinhole's."""
        return np.asarray(cv2.remap(image, *self.maps, cv2.INTER_LINEAR))

    def distort_depth(self, depth: Float32) -> Float32:
        """The camera's depth (H, W) of the pinhole's: nearest, because depths do not mix."""
        return np.asarray(cv2.remap(depth, self.maps[0], None, cv2.INTER_NEAREST))
