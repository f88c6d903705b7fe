"""Estimates the camera model and its uncertainty from views of the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from companion.calibrate.board import BoardView
from companion.errors import RecordError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array

_LEAST_VIEWS = 8
_OUTLIER = 3.0  # medians of a view's own error: blurred, or a bent board
_K3_GAIN = 0.97  # k3 is used where the errors fall below this share without it
_SIGMA_FACTOR = 2.0  # a board is not flat, and its corners do not err independently


@dataclass(frozen=True)
class LensEstimate:
    """The camera model. sigmas: (9,) of fx, fy, cx, cy, k1, k2, p1, p2, k3; rms_px: of the corners;
    views: number used, number in all.
    """

    camera: Camera
    sigmas: Array
    rms_px: float
    views: tuple[int, int]


def solve_lens(views: Sequence[BoardView], width: int, height: int) -> LensEstimate:
    """Estimate the camera from views (Zhang 2000), without those whose error is three times the
    median. width, height: of their images, px. `RecordError` with fewer than eight views.
    """
    if len(views) < _LEAST_VIEWS:
        raise RecordError(
            f"{len(views)} usable views of the board; the camera's model needs {_LEAST_VIEWS}, "
            "better 16: all over the picture, near, and tilted"
        )
    used = list(views)
    fitted = _fit(used, (width, height), with_k3=False)
    limit = _OUTLIER * float(np.median(fitted.errors))
    kept = [v for v, e in zip(used, fitted.errors, strict=True) if e <= limit]
    if _LEAST_VIEWS <= len(kept) < len(used):
        used, fitted = kept, _fit(kept, (width, height), with_k3=False)
    more = _fit(used, (width, height), with_k3=True)
    if more.rms < _K3_GAIN * fitted.rms:
        fitted = more
    K, d = fitted.K, fitted.distortion
    camera = Camera(
        width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]),
        (float(d[0]), float(d[1]), float(d[2]), float(d[3]), float(d[4])),
    )  # fmt: skip
    return LensEstimate(camera, _SIGMA_FACTOR * fitted.sigmas, fitted.rms, (len(used), len(views)))


@dataclass(frozen=True)
class _Fit:
    """Result of OpenCV. errors: (N,) px of each view."""

    K: Array
    distortion: Array
    sigmas: Array
    errors: Array
    rms: float


def _fit(views: Sequence[BoardView], size: tuple[int, int], *, with_k3: bool) -> _Fit:
    objects = [v.objects.astype(np.float32) for v in views]
    # Corners count from the picture's edge here, so the principal point does, too.
    pixels = [v.pixels.astype(np.float32) for v in views]
    flags = 0 if with_k3 else cv2.CALIB_FIX_K3
    rms, K, d, _, _, sigmas, _, errors = cv2.calibrateCameraExtended(
        objects, pixels, size, np.eye(3), np.zeros(5), flags=flags
    )
    flat = np.asarray(sigmas, np.float64).ravel()[:9]
    return _Fit(
        np.asarray(K, np.float64), np.asarray(d, np.float64).ravel()[:5], flat,
        np.asarray(errors, np.float64).ravel(), float(rms),
    )  # fmt: skip
