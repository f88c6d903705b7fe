"""Pinhole camera with Brown distortion.

Pixel convention: the centre of the first pixel is (0.5, 0.5), the image spans [0, width] x
[0, height]. OpenCV puts that centre at (0, 0); conversions to it happen here and nowhere else.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from localizer.errors import CameraError
from localizer.geometry.pose import Array
from localizer.plain_files import plain_text

MAX_READOUT_MS = 200.0
_ALIKE, _ALIKE_PX = 1e-3, 0.01  # of a focal length, a share: 0.2 px at a working picture's edge
_KEYS = ("width", "height", "fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels. `distortion` is Brown's (k1, k2, p1, p2, k3), all 0 for a pinhole.
    readout_ms: from the first row's exposure to the last one's, 0 of a global shutter.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    readout_ms: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(np.isfinite(numbers)):
            raise CameraError(f"camera intrinsics must be finite numbers, got {self}")
        if not 0.0 <= self.readout_ms <= MAX_READOUT_MS:
            raise CameraError(
                f"a readout of {self.readout_ms:g} ms: give milliseconds from the first row's "
                f"exposure to the last one's, 0 to {MAX_READOUT_MS:g}"
            )
        if self.width < 8 or self.height < 8:
            raise CameraError(f"camera size {self.width}x{self.height} is below 8x8 pixels")
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(f"focal lengths must be positive, got fx={self.fx} fy={self.fy}")
        if len(self.distortion) != 5:
            raise CameraError(f"distortion needs k1 k2 p1 p2 k3, got {self.distortion}")

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov_deg: float) -> Camera:
        """Ideal pinhole with square pixels and the given horizontal field of view."""
        f = 0.5 * width / np.tan(0.5 * np.radians(horizontal_fov_deg))
        return cls(width, height, float(f), float(f), width / 2, height / 2)

    @classmethod
    def from_dict(cls, data: dict[str, Any], where: str = "camera") -> Camera:
        """From width, height, fx, fy, cx, cy and optional ``distortion`` (k1 k2 p1 p2 k3) and
        ``readout_ms``.

        The distortion may also stand as the single keys k1, k2, p1, p2, k3.
        """
        missing = [k for k in _KEYS if k not in data]
        if missing:
            raise CameraError(f"{where}: missing {', '.join(missing)}")
        d = data.get("distortion") or [data.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3")]
        try:
            k = (*(float(x) for x in d), 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
            fx, fy, cx, cy = (float(data[key]) for key in _KEYS[2:])
            width, height = int(data["width"]), int(data["height"])
            bent = (k[0], k[1], k[2], k[3], k[4])
            readout_ms = float(data.get("readout_ms", 0.0))
            return cls(width, height, fx, fy, cx, cy, bent, readout_ms)
        except (TypeError, ValueError, OverflowError, CameraError) as error:
            raise CameraError(f"{where}: {error}") from error

    @classmethod
    def from_json(cls, path: Path | str) -> Camera:
        """From a ``camera.json`` file."""
        try:
            data = json.loads(plain_text(Path(path)))
        except FileNotFoundError as error:
            raise CameraError(f"{path}: does not exist") from error
        except (OSError, ValueError, RecursionError) as error:
            raise CameraError(f"{path}: cannot be read as JSON: {error}") from error
        if not isinstance(data, dict):
            raise CameraError(f"{path}: expected an object with {', '.join(_KEYS)}")
        return cls.from_dict(data, str(path))

    def to_dict(self) -> dict[str, Any]:
        """Inverse of `from_dict`."""
        return {k: getattr(self, k) for k in _KEYS} | {
            "distortion": list(self.distortion), "readout_ms": self.readout_ms
        }  # fmt: skip

    @property
    def K(self) -> Array:
        """Calibration matrix (3, 3) in this package's pixel convention."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient is not zero."""
        return any(k != 0.0 for k in self.distortion)

    def is_like(self, other: Camera) -> bool:
        """Whether images of both are interchangeable: focal lengths to 0.1 %, principal
        points to 0.01 px, size and distortion the same.
        """
        scales = self.fx / other.fx, self.fy / other.fy
        apart = max(abs(self.cx - other.cx), abs(self.cy - other.cy))
        same = ("width", "height", "distortion")
        return (
            all(abs(s - 1.0) <= _ALIKE for s in scales)
            and apart <= _ALIKE_PX
            and all(getattr(self, name) == getattr(other, name) for name in same)
        )

    @property
    def horizontal_fov_deg(self) -> float:
        """Horizontal field of view in degrees, without distortion."""
        left, right = self.cx / self.fx, (self.width - self.cx) / self.fx
        return float(np.degrees(np.arctan(left) + np.arctan(right)))

    @property
    def vertical_fov_deg(self) -> float:
        """Vertical field of view in degrees, without distortion."""
        top, bottom = self.cy / self.fy, (self.height - self.cy) / self.fy
        return float(np.degrees(np.arctan(top) + np.arctan(bottom)))

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with its image resampled to another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def without_distortion(self) -> Camera:
        """The ideal pinhole with the same K."""
        return replace(self, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))

    def project(self, points: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Points (..., 3) in the camera frame to pixels (..., 2) and a mask of what is in view.

        Points behind the camera give NaN pixels and are not in view.
        """
        points = np.asarray(points, dtype=np.float64)
        z = points[..., 2]
        front = z > 1e-6
        safe = np.where(front, z, np.nan)
        x, y = points[..., 0] / safe, points[..., 1] / safe
        xd, yd = self._distort(x, y)
        pixels = np.stack([self.fx * xd + self.cx, self.fy * yd + self.cy], axis=-1)
        inside = (
            front
            & (pixels[..., 0] >= 0)
            & (pixels[..., 0] <= self.width)
            & (pixels[..., 1] >= 0)
            & (pixels[..., 1] <= self.height)
        )
        return pixels, inside

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions (..., 3) in the camera frame, z = 1, of pixels (..., 2); distortion undone."""
        pixels = np.asarray(pixels, dtype=np.float64)
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        if self.is_distorted:
            flat = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-12)
            flat = cv2.undistortPoints(
                flat, np.eye(3), np.asarray(self.distortion), criteria=criteria
            )
            x, y = flat[:, 0, 0].reshape(x.shape), flat[:, 0, 1].reshape(y.shape)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def undistortion_maps(self, target: Camera) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        """Fixed-point maps for ``cv2.remap`` from this camera's image to the pinhole `target`.

        They undo the distortion and resize in one pass.
        """
        maps = cv2.initUndistortRectifyMap(
            _opencv_matrix(self),
            np.asarray(self.distortion),
            np.eye(3),
            _opencv_matrix(target),
            (target.width, target.height),
            cv2.CV_16SC2,
        )
        return maps[0].astype(np.int16), maps[1].astype(np.uint16)

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        if not self.is_distorted:
            return x, y
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return xd, yd


def followed(pinhole: Camera, camera: Camera) -> Camera:
    """The pinhole, of its own size, that sees what a (distorted) camera sees now: `pinhole` itself
    while the camera is the one that it was made for, at whatever size.
    """
    own = camera.without_distortion().resized(pinhole.width, pinhole.height)
    return pinhole if own.is_like(pinhole) else own


def _opencv_matrix(camera: Camera) -> Array:
    K = camera.K
    K[:2, 2] -= 0.5
    return K
