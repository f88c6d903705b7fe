"""Measures where an image shows points of the map, patch by patch, without a camera model.

Each of 13 patches of the image is shifted until its features match the map's, by least squares.
Remaining shifts in one direction, or growing from the centre, are errors of the camera model and
not of the pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.features.extractor import FeatureExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.geometry.shutter import Sweep
from localizer.registration.anchors import apply_sweep
from localizer.registration.backend import sample_bilinear
from localizer.registration.cpu.reference import feature_gradients
from localizer.render.base import MapRenderer
from localizer.tracking.pipeline import Undistorter, reference_anchors, working_camera
from localizer.types import Anchors, FeatureLevel, FeaturePyramid, Float32, Frame

_PART_SHARE = 0.075  # of the working width
_LEAST_ANCHORS = 12
_STEPS = 4
_FARTHEST_SHARE = 0.01  # of the working width, from where the pose has it: beyond is another thing
_LEAST_CURVATURE = 0.02  # of a part's weakest direction against the picture's median: an edge
_ANCHORS = 4000
_LEAST_SCALE = 0.02


@dataclass(frozen=True)
class Parts:
    """Measurements of one image. points: (N, 3) world; pixels: (N, 2) of the original distorted
    image; information: (N, 2, 2), 1/px².
    """

    points: Array
    pixels: Array
    information: Array


class PictureReader:
    """Renders the map at an image's pose and measures where the image shows the map's points.

    camera: the assumed model, which may be wrong by some per cent.
    """

    def __init__(
        self, renderer: MapRenderer, extractor: FeatureExtractor, camera: Camera, width: int
    ) -> None:
        self._renderer, self._extractor = renderer, extractor
        self._camera, self._working = camera, working_camera(camera, width)
        self._undistorter = Undistorter(camera, self._working)

    def read(self, frame: Frame, pose: Pose, sweep: Sweep | None) -> Parts | None:
        """The patches of an image taken at `pose`, with rolling shutter `sweep` (None: global).
        None if the map or the image shows too little.
        """
        view = self._renderer.render(pose, self._working, wait=True)
        if np.count_nonzero(view.depth) < 0.2 * view.depth.size:
            return None
        anchors = reference_anchors(view, self._extractor, _ANCHORS, 0)
        if len(anchors.points_world) < 10 * _LEAST_ANCHORS:
            return None
        anchors = apply_sweep(anchors, sweep, pose, self._camera)
        query = self._extractor.extract(self._undistorter(frame))
        return self._measured(anchors, query, pose)

    def _measured(self, anchors: Anchors, query: FeaturePyramid, pose: Pose) -> Parts | None:
        uv, seen = self._working.project(pose.inverse.apply(anchors.points_world))
        uv = np.where(seen[:, None], uv, 0.0)
        side = _PART_SHARE * self._working.width
        across = int(np.ceil(self._working.width / side))
        part = (uv[:, 1] // side).astype(np.int64) * across
        part = np.where(seen, part + (uv[:, 0] // side).astype(np.int64), -1)
        names = np.unique(part[part >= 0])
        number = np.searchsorted(names, part)
        shift = np.zeros((len(names), 2))
        members = np.flatnonzero(part >= 0)
        number = number[members]
        curvature = np.zeros((len(names), 2, 2))
        fit = np.full(len(names), np.inf)
        for k in (-2, -1):  # the network's finest level, then the picture's own detail
            level = query.levels[k]
            of_map = anchors.features[k][members], anchors.confidence[k][members]
            for _ in range(_STEPS):
                at = uv[members] + shift[number]
                step, curvature, fit = _step(level, at, of_map, number, len(names))
                shift = shift + np.clip(step, -1.0, 1.0) * level.stride
        count = np.bincount(number, minlength=len(names))
        weakest = np.linalg.eigvalsh(curvature)[:, 0]
        typical = float(np.median(weakest))
        good = (
            (count >= _LEAST_ANCHORS)
            & (np.hypot(*shift.T) < _FARTHEST_SHARE * self._working.width)
            & (weakest > _LEAST_CURVATURE * max(typical, 1e-12))
            & (fit <= 2.0 * np.median(fit) + _LEAST_SCALE)
        )
        if np.count_nonzero(good) < 6:
            return None
        points = anchors.points_world[members]
        return self._parts(points, uv[members], number, shift, curvature, good)

    def _parts(
        self, points: Array, uv: Array, number: NDArray[np.int64], shift: Array,
        curvature: Array, good: NDArray[np.bool_],
    ) -> Parts:  # fmt: skip
        """One point for each good patch: the anchor nearest its middle, and its measured pixel."""
        chosen = []
        for k in np.flatnonzero(good):
            members = np.flatnonzero(number == k)
            middle = np.median(uv[members], axis=0)
            chosen.append(members[np.argmin(np.hypot(*(uv[members] - middle).T))])
        at = uv[chosen] + shift[good]
        rays = self._working.rays(at)
        pixels, _ = self._camera.project(rays)
        scale = self._camera.width / self._working.width
        typical = np.median(np.trace(curvature[good], axis1=1, axis2=2))
        return Parts(points[chosen], pixels, curvature[good] / (typical * scale**2))


def _step(
    level: FeatureLevel, at: Array, of_map: tuple[Float32, Float32], number: NDArray[np.int64],
    count: int,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """One Gauss-Newton step (count, 2) of every patch, in the level's cells; its normal equations
    (count, 2, 2) and the patches' mean residual (count,).
    """
    features, confidence = of_map
    u, v = (at / level.stride - 0.5).T
    residual = sample_bilinear(level.features, u, v) - features
    gx, gy = feature_gradients(level.features, u, v)
    norm = np.linalg.norm(residual, axis=1)
    scale = max(1.5 * float(np.median(norm)), _LEAST_SCALE)
    weight = confidence * sample_bilinear(level.confidence, u, v) / (1.0 + (norm / scale) ** 2) ** 2
    xx, xy, yy = ((a * b).sum(axis=1) * weight for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    bx, by = ((g * residual).sum(axis=1) * weight for g in (gx, gy))
    sums = [np.bincount(number, weights=w, minlength=count) for w in (xx, xy, yy, bx, by)]
    four = np.stack([sums[0], sums[1], sums[1], sums[2]], axis=1)
    H: Array = four.astype(np.float64).reshape(-1, 2, 2)
    damped = H + np.eye(2) * (1e-6 + 1e-3 * np.trace(H, axis1=1, axis2=2)[:, None, None])
    step = -np.linalg.solve(damped, np.stack(sums[3:], axis=1)[..., None])[..., 0]
    total = np.maximum(np.bincount(number, weights=weight, minlength=count), 1e-12)
    fit = np.bincount(number, weights=weight * norm, minlength=count) / total
    return step, H, fit
