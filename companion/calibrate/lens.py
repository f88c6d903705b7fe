"""Estimates the camera model and its uncertainty from views of the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
    lens, errors = _fit(used, (width, height), with_k3=False)
    kept = [v for v, e in zip(used, errors, strict=True) if e <= _OUTLIER * np.median(errors)]
    if _LEAST_VIEWS <= len(kept) < len(used):
        used, lens = kept, _fit(kept, (width, height), with_k3=False)[0]
    more, _ = _fit(used, (width, height), with_k3=True)
    found = more if more.rms_px < _K3_GAIN * lens.rms_px else lens
    return replace(found, views=(len(used), len(views)))


def _fit(
    views: Sequence[BoardView], size: tuple[int, int], *, with_k3: bool
) -> tuple[LensEstimate, Array]:
    """The camera model, and the error of each view, (N,) px."""
    objects = [v.objects.astype(np.float32) for v in views]
    # Corners count from the picture's edge here, so the principal point does, too.
    pixels = [v.pixels.astype(np.float32) for v in views]
    flags = 0 if with_k3 else cv2.CALIB_FIX_K3
    rms, K, d, _, _, sigmas, _, errors = cv2.calibrateCameraExtended(
        objects, pixels, size, np.eye(3), np.zeros(5), flags=flags
    )
    k1, k2, p1, p2, k3 = map(float, np.ravel(d)[:5])
    camera = Camera(
        *size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), (k1, k2, p1, p2, k3)
    )
    wide = _SIGMA_FACTOR * np.asarray(sigmas, np.float64).ravel()[:9]
    return LensEstimate(camera, wide, float(rms), (len(views),) * 2), np.ravel(errors)
