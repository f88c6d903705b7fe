"""Lens models: undistorted coordinates (x / z, y / z) to distorted ones, and back.

``opencv``: Brown's k1 k2 p1 p2 k3; with k4 k5 k6 the rational model; with s1 s2 s3 s4 the thin
prism; with tau_x tau_y the tilted sensor (OpenCV, calib3d). ``fisheye``: k1 k2 k3 k4 of Kannala and
Brandt 2006 as in ``cv2.fisheye``: radius = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8), a the angle
from the optical axis.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array

LensModel = Literal["opencv", "fisheye"]
COUNTS: dict[LensModel, tuple[int, ...]] = {"opencv": (5, 8, 12, 14), "fisheye": (4,)}
COEFFICIENTS: dict[LensModel, tuple[str, ...]] = {
    "opencv": (
        "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y"
    ),
    "fisheye": ("k1", "k2", "k3", "k4"),
}  # fmt: skip
_Project = Callable[[Array], tuple[Array, NDArray[np.bool_]]]
_GRID = 21  # points along each side
_SAME = 1e-4  # of the longer side: 0.1 px of 1000
# Of a straight line's length. Equidistant lenses of 150 degrees reach 0.22 outwards; the strongest
# cushion of a camera's lens is some 0.03.
_MOST_OUTWARD, _MOST_INWARD = 0.25, 0.06
_CHECK = (
    "check the lens model's name, the order of its coefficients and the image's size that they "
    "are of"
)
_WIDEST = np.radians(85.0)  # from the optical axis: beyond, a ray has no useful tangent
_STEPS = 20


def whole_coefficients(model: LensModel, given: tuple[float, ...]) -> tuple[float, ...]:
    """The coefficients padded with zeros to the model's next count, without superfluous zeros;
    ValueError for a number that the model does not have.
    """
    least, most = COUNTS[model][0], COUNTS[model][-1]
    used = max((i + 1 for i, k in enumerate(given) if k != 0.0), default=0)
    if used > least and len(given) not in COUNTS[model]:
        names = " ".join(COEFFICIENTS[model])
        counts = ", ".join(str(n) for n in COUNTS[model])
        raise ValueError(
            f"{len(given)} distortion coefficients: the model {model} has {counts} ({names})"
        )
    count = next((n for n in COUNTS[model] if n >= used), most)
    return (*given, *(0.0,) * most)[:count]


def distorted(model: LensModel, k: tuple[float, ...], x: Array, y: Array) -> tuple[Array, Array]:
    """Distorted image coordinates of undistorted ones (x / z, y / z), any shape. k: the model's
    coefficients (module docstring).
    """
    if model == "fisheye":
        r = np.hypot(x, y)
        angle = np.arctan(r)
        scale = _fisheye_radius(k, angle) / np.maximum(r, 1e-12)
        return x * np.where(r > 1e-12, scale, 1.0), y * np.where(r > 1e-12, scale, 1.0)
    if len(k) == 5:
        k1, k2, p1, p2, k3 = k
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return xd, yd
    points = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 1, 3)
    still, eye = np.zeros(3), np.eye(3)
    flat = np.asarray(cv2.projectPoints(points, still, still, eye, np.asarray(k))[0])
    return flat[:, 0, 0].reshape(x.shape), flat[:, 0, 1].reshape(y.shape)


def undistorted(model: LensModel, k: tuple[float, ...], x: Array, y: Array) -> tuple[Array, Array]:
    """Inverse of `distorted`; NaN for a fisheye ray at more than 85 degrees from the axis."""
    if model == "fisheye":
        r = np.hypot(x, y)
        angle = _fisheye_angle(k, r)
        scale = np.where(r > 1e-12, np.tan(angle) / np.maximum(r, 1e-12), 1.0)
        return x * scale, y * scale
    flat = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-12)
    flat = cv2.undistortPoints(flat, np.eye(3), np.asarray(k), criteria=criteria)
    return flat[:, 0, 0].reshape(x.shape), flat[:, 0, 1].reshape(y.shape)


def _fisheye_radius(k: tuple[float, ...], angle: Array) -> Array:
    a2 = angle * angle
    radius: Array = angle * (1 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
    return radius


def _fisheye_angle(k: tuple[float, ...], radius: Array) -> Array:
    """Angle (rad) of a distorted radius, by Newton's method; NaN if it does not converge."""
    angle = np.minimum(radius, _WIDEST)
    for _ in range(_STEPS):
        a2 = angle * angle
        slope = 1 + a2 * (3 * k[0] + a2 * (5 * k[1] + a2 * (7 * k[2] + a2 * 9 * k[3])))
        step = (_fisheye_radius(k, angle) - radius) / np.where(slope > 1e-3, slope, np.nan)
        angle = np.clip(angle - step, 0.0, _WIDEST)
    found = np.abs(_fisheye_radius(k, angle) - radius) < 1e-9
    return np.where(found, angle, np.nan)


def fault(size: tuple[int, int], rays: Callable[[Array], Array], project: _Project) -> str:
    """Why a lens model is impossible; "" if it is possible. size: of the image, px; rays (z = 1),
    project: the camera's functions.

    Two conditions hold for a possible lens. Every pixel of a grid up to the image's edges has a ray
    that projects back onto this pixel, and neighbouring rays keep the pixels' order. A straight
    line between two corners is not bent more than by any real lens.
    """
    u, v = np.meshgrid(*(np.linspace(0.0, side, _GRID) for side in size))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    seen = rays(pixels)
    off = np.linalg.norm(project(seen)[0] - pixels, axis=1)
    lost = pixels[~((off < _SAME * max(size)) & _upright(seen[:, :2]))]
    if len(lost) and np.isnan(seen).any():
        return (
            f"the image shows more than {np.degrees(_WIDEST):.0f} degrees from the optical axis; "
            f"crop it, or {_CHECK}"
        )
    if len(lost):
        return (
            f"the distortion cannot be undone on {len(lost) / len(pixels):.0%} of the image, as "
            f"at {lost[0][0]:.0f}, {lost[0][1]:.0f} px; {_CHECK}. If all are right, calibrate "
            "again with fewer coefficients: one too many (k3) folds the corners"
        )
    w, h = size
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h], [0, 0]], np.float64)
    ends = rays(corners)
    for begin, end, a, b in zip(corners, corners[1:], ends, ends[1:], strict=False):
        along = (end - begin) / np.linalg.norm(end - begin)
        line = a + np.linspace(0.0, 1.0, _GRID)[:, None] * (b - a)
        away = (project(line)[0] - begin) @ np.array([along[1], -along[0]])  # outwards
        bow = float(max(away, key=abs)) / float(np.linalg.norm(end - begin))
        if not -_MOST_INWARD <= bow <= _MOST_OUTWARD:
            return (
                f"the distortion bends a straight line along the image's edge by {abs(bow):.0%} "
                f"of its length, more than a lens does; {_CHECK}"
            )
    return ""


def _upright(tangents: Array) -> NDArray[np.bool_]:
    """Mask of the pixels of a grid (_GRID squared, 2) whose rays have the pixels' order."""
    grid = tangents.reshape(_GRID, _GRID, 2)
    by_u, by_v = (np.asarray(np.gradient(grid, axis=axis)) for axis in (1, 0))
    area: Array = by_u[..., 0] * by_v[..., 1] - by_u[..., 1] * by_v[..., 0]
    return (area > 0.0).ravel()
