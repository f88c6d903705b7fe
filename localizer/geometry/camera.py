"""Camera model: pinhole and lens distortion (`localizer.geometry.lens`).

Pixel convention: the centre of the first pixel is (0.5, 0.5), the image spans [0, width] x [0,
height]. OpenCV puts that centre at (0, 0); only this module converts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from localizer.errors import CameraError
from localizer.geometry import lens
from localizer.geometry.camera_file import KEYS, camera_numbers, read_numbers
from localizer.geometry.lens import LensModel
from localizer.geometry.pose import Array

MAX_READOUT_MS = 200.0
_ALIKE, _ALIKE_PX = 1e-3, 0.01  # of a focal length, a share: 0.2 px at a working picture's edge
_NONE = (0.0, 0.0, 0.0, 0.0, 0.0)
_EDGE = 33  # points along each side


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels. distortion: for the model ``opencv`` Brown's (k1, k2, p1, p2, k3), all
    0 for a pinhole, or 8, 12 or 14 of OpenCV's parameters; for ``fisheye`` (k1, k2, k3, k4).
    readout_ms: time between the exposures of the first and the last row, 0 for a global shutter.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = _NONE
    readout_ms: float = 0.0
    distortion_model: LensModel = "opencv"

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
        if len(self.distortion) not in lens.COUNTS.get(self.distortion_model, ()):
            names = " ".join(lens.COEFFICIENTS.get(self.distortion_model, lens.COUNTS))
            raise CameraError(f"distortion needs {names}, got {self.distortion}")

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov_deg: float) -> Camera:
        """Ideal pinhole with square pixels, this field of view, and the axis at the centre."""
        f = 0.5 * width / np.tan(0.5 * np.radians(horizontal_fov_deg))
        return cls(width, height, float(f), float(f), width / 2, height / 2)

    @classmethod
    def from_dict(cls, data: dict[str, Any], where: str = "camera") -> Camera:
        """Camera of width, height, fx, fy, cx, cy and optional ``distortion``, ``distortion_model``
        and ``readout_ms``, or of other programs' keys (`localizer.geometry.camera_file`).

        `CameraError` for a distortion model that is not supported, and for impossible values.
        where: begins its text.
        """
        try:
            camera = cls(**camera_numbers(data))
            if fault := lens_fault(camera):
                raise CameraError(fault)
        except (TypeError, ValueError, OverflowError, CameraError) as error:
            raise CameraError(f"{where}: {error}") from error
        return camera

    @classmethod
    def from_json(cls, path: Path | str) -> Camera:
        """Camera of a ``camera.json`` file, or of another program's file
        (`camera_file.read_numbers`). `CameraError` if it cannot be read, and as `from_dict`.
        """
        return cls.from_dict(read_numbers(Path(path)), str(path))

    def to_dict(self) -> dict[str, Any]:
        """Inverse of `from_dict`, as JSON data under this project's keys."""
        return {k: getattr(self, k) for k in KEYS} | {
            "distortion": list(self.distortion), "distortion_model": self.distortion_model,
            "readout_ms": self.readout_ms,
        }  # fmt: skip

    @property
    def K(self) -> Array:
        """Calibration matrix (3, 3); the first pixel's centre is (0.5, 0.5), unlike OpenCV's."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Whether the lens has distortion; always True for a fisheye."""
        return self.distortion_model != "opencv" or any(k != 0.0 for k in self.distortion)

    def is_like(self, other: Camera) -> bool:
        """Whether images of both are interchangeable: focal lengths to 0.1 %, principal
        points to 0.01 px, size and distortion the same. The readout time may differ.
        """
        scales = self.fx / other.fx, self.fy / other.fy
        apart = max(abs(self.cx - other.cx), abs(self.cy - other.cy))
        same = ("width", "height", "distortion", "distortion_model")
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
        return replace(self, distortion=_NONE, distortion_model="opencv")

    def project(self, points: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Points (..., 3) in the camera frame to pixels (..., 2) and a mask of what is in view.

        Points behind the camera give NaN pixels and are not in view. Points beyond the angle that
        the lens shows are not in view either, even if their pixels lie in the image.
        """
        points = np.asarray(points, dtype=np.float64)
        z = points[..., 2]
        front = z > 1e-6
        safe = np.where(front, z, np.nan)
        x, y = points[..., 0] / safe, points[..., 1] / safe
        xd, yd = self.distorted(x, y)
        pixels = np.stack([self.fx * xd + self.cx, self.fy * yd + self.cy], axis=-1)
        inside = (
            front
            & (pixels[..., 0] >= 0)
            & (pixels[..., 0] <= self.width)
            & (pixels[..., 1] >= 0)
            & (pixels[..., 1] <= self.height)
        )
        if self.is_distorted:
            inside &= x * x + y * y <= self._reach**2
        return pixels, inside

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions (..., 3) in the camera frame, z = 1 (not unit length), of pixels (..., 2);
        distortion undone. NaN more than 85 degrees from a fisheye's axis.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        if self.is_distorted:
            x, y = lens.undistorted(self.distortion_model, self.distortion, x, y)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def undistortion_maps(self, target: Camera) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        """Fixed-point maps for ``cv2.remap`` from this camera's image to `target`'s, an undistorted
        camera: int16 (H, W, 2) and uint16 (H, W).

        They undo the distortion and resize in one pass. Pixels outside the lens's field of view
        point outside the image; with a constant border they become black.
        """
        if self.distortion_model == "opencv":
            maps = cv2.initUndistortRectifyMap(
                _opencv_matrix(self),
                np.asarray(self.distortion),
                np.eye(3),
                _opencv_matrix(target),
                (target.width, target.height),
                cv2.CV_16SC2,
            )
        else:
            pixels = self.project(target.rays(_centres(target)))[0] - 0.5
            maps = cv2.convertMaps(pixels.astype(np.float32), None, cv2.CV_16SC2)
        places = maps[0].astype(np.int16)
        corners = [[0, 0], [target.width, 0], [0, target.height], [target.width, target.height]]
        if self.is_distorted and np.hypot(*target.rays(corners).T[:2]).max() > self._reach:
            x, y, _ = np.moveaxis(target.rays(_centres(target)), -1, 0)
            places[np.hypot(x, y) > self._reach] = np.iinfo(np.int16).min
        return places, maps[1].astype(np.uint16)

    def distorted(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distorted image coordinates (pixels after focal length and principal point) of rays' x /
        z and y / z, any shape.
        """
        if not self.is_distorted:
            return x, y
        return lens.distorted(self.distortion_model, self.distortion, x, y)

    @cached_property
    def _reach(self) -> float:
        """Largest tangent of the angle from the axis to a pixel. Beyond it a lens polynomial folds
        rays back into the image, a lens does not.
        """
        u, v = np.linspace(0.0, self.width, _EDGE), np.linspace(0.0, self.height, _EDGE)
        edges = [np.stack(np.broadcast_arrays(u, side), -1) for side in (0.0, self.height)]
        edges += [np.stack(np.broadcast_arrays(side, v), -1) for side in (0.0, self.width)]
        x, y, _ = self.rays(np.concatenate(edges)).T
        return float(np.fmax.reduce(np.hypot(x, y), initial=0.0)) * (1.0 + _ALIKE)


def lens_fault(camera: Camera) -> str:
    """Why the lens model is impossible, "" if it is possible (`lens.fault`)."""
    size = camera.width, camera.height
    return lens.fault(size, camera.rays, camera.project) if camera.is_distorted else ""


def with_field_of_view(pinhole: Camera, camera: Camera) -> Camera:
    """The pinhole with the field of view of a (distorted, possibly zoomed) camera, at the pinhole's
    size; unchanged if the camera is the one it was made for.
    """
    own = camera.without_distortion().resized(pinhole.width, pinhole.height)
    return pinhole if own.is_like(pinhole) else own


def _centres(camera: Camera) -> Array:
    """(H, W, 2) pixel coordinates of all pixel centres."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([u, v], axis=-1) + 0.5


def _opencv_matrix(camera: Camera) -> Array:
    K = camera.K
    K[:2, 2] -= 0.5
    return K
