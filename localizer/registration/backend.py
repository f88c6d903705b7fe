"""Input and output of the registration backends (registration.md, section 3).

A pose inside the optimizer is `camera_from_local`: a rotation and a translation that map local
points to the camera. The local frame has world axes and its origin at the anchors' weighted
centroid, so that float32 points are exact to micrometres and translation and rotation decouple.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.types import Anchors, FeatureLevel, FeaturePyramid, Float32


@dataclass(frozen=True)
class LMSettings:
    """Levenberg-Marquardt and robust-loss settings (registration.md, sections 3 and 5).

    scale: residual norm at which the loss stops to be quadratic: Huber's threshold, or Geman and
    McClure's scale if `redescending`. Unit features differ by at most 2. damping: share of each
    diagonal element that is added to it (Marquardt's scaling) in the first step; multiplied by
    damping_down after an accepted step and by damping_up after a rejected one. min_overlap: share
    of the anchors that must project into the image.
    """

    scale: float = 0.5
    redescending: bool = False
    damping: float = 0.03
    damping_down: float = 0.3
    damping_up: float = 8.0
    min_overlap: float = 0.25


@dataclass(frozen=True)
class QuadraticPrior:
    """Knowledge of the pose from other sensors, added to the cost as ``weight * d' L d``.

    d: difference (6,) of a pose from `camera_from_local`, in the order of `PosePrior`'s covariance
    (camera position and left rotation vector, world axes). information: L (6, 6), 0 on unknown
    axes.
    """

    camera_from_local: Pose
    information: Array
    weight: float


@dataclass(frozen=True)
class LevelProblem:
    """One pyramid level, ready for a backend.

    features: (h, w, C), confidence: (h, w) of the query; focal (fx, fy) and centre (cx, cy) in
    array index units of this level; points: (3, N) float32 in the local frame; anchor_features:
    (N, C); anchor_confidence: (N,).
    """

    features: Float32
    confidence: Float32
    focal: tuple[float, float]
    centre: tuple[float, float]
    points: Float32
    anchor_features: Float32
    anchor_confidence: Float32
    prior: QuadraticPrior | None = None


@dataclass(frozen=True)
class Refinement:
    """M refined hypotheses. rotations: (M, 3, 3), translations: (M, 3), camera_from_local;
    scores: (M,) mean robust cost after the last step, inf where the overlap is too small;
    overlaps: (M,) share of the anchors in the image; evaluations: cost evaluations in all.
    """

    rotations: Array
    translations: Array
    scores: Array
    overlaps: Array
    evaluations: int


class Backend(Protocol):
    """Implementation of the optimizer's inner loop: refines many pose hypotheses on one pyramid
    level by Levenberg-Marquardt, on the CPU or a GPU.
    """

    name: str

    def refine(
        self,
        problem: LevelProblem,
        rotations: Array,
        translations: Array,
        iterations: int,
        settings: LMSettings,
    ) -> Refinement:
        """Run `iterations` LM steps on each of M poses camera_from_local: rotations (M, 3, 3),
        translations (M, 3), which are not changed. 0 iterations only score them. The scores contain
        the problem's prior. `BackendError` if a GPU fails.
        """
        ...


def level_intrinsics(
    camera: Camera, level: FeatureLevel
) -> tuple[tuple[float, float], tuple[float, float]]:
    """(fx, fy), (cx, cy) in array index units: image pixel u lies at index ``u / stride - 0.5``."""
    s = float(level.stride)
    return (camera.fx / s, camera.fy / s), (camera.cx / s - 0.5, camera.cy / s - 0.5)


def local_origin(anchors: Anchors, world_from_camera: Pose) -> Array:
    """Origin (3,) of the local frame: the anchors' centroid, each weighted by 1 / depth².

    An anchor's information about translation has this weight. So translation and rotation are
    nearly uncorrelated about this point (docs/explanation/registration.md, section 4).
    """
    depth = world_from_camera.inverse.apply(anchors.points_world)[:, 2]
    weight = 1.0 / np.maximum(np.abs(depth), 1.0) ** 2
    origin: Array = weight @ anchors.points_world / weight.sum()
    return origin


def level_problems(
    query: FeaturePyramid, camera: Camera, anchors: Anchors, origin: Array
) -> tuple[LevelProblem, ...]:
    """The problems of all levels, coarse to fine, in the local frame about `origin` (3,)."""
    points = np.ascontiguousarray((anchors.points_world - origin).T, dtype=np.float32)
    problems = []
    for level, features, confidence in zip(
        query.levels, anchors.features, anchors.confidence, strict=True
    ):
        focal, centre = level_intrinsics(camera, level)
        problems.append(
            LevelProblem(
                np.ascontiguousarray(level.features, dtype=np.float32),
                np.ascontiguousarray(level.confidence, dtype=np.float32),
                focal,
                centre,
                points,
                np.ascontiguousarray(features, dtype=np.float32),
                np.ascontiguousarray(confidence, dtype=np.float32),
            )
        )
    return tuple(problems)


def sample_bilinear(image: NDArray[np.float32], x: Array, y: Array) -> Array:
    """Values (N, C) or (N,) of an image (h, w, C) or (h, w) at array index coordinates, clamped."""
    h, w = image.shape[:2]
    x, y = np.clip(x, 0.0, w - 1.0), np.clip(y, 0.0, h - 1.0)
    x0 = np.minimum(x.astype(np.int64), w - 2)
    y0 = np.minimum(y.astype(np.int64), h - 2)
    ax, ay = x - x0, y - y0
    if image.ndim == 3:
        ax, ay = ax[:, None], ay[:, None]
    top = image[y0, x0] * (1 - ax) + image[y0, x0 + 1] * ax
    bottom = image[y0 + 1, x0] * (1 - ax) + image[y0 + 1, x0 + 1] * ax
    values: Array = top * (1 - ay) + bottom * ay
    return values


def camera_from_local(rotations: Array, centres: Array, origin: Array) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) and translations (M, 3) of camera_from_local, of M poses
    world_from_camera with rotations (M, 3, 3) and centres (M, 3). origin: the local frame's, in
    world coordinates.
    """
    inverse = np.ascontiguousarray(np.swapaxes(rotations, 1, 2))
    return inverse, np.einsum("mij,mj->mi", inverse, origin - centres)


def world_from_camera(rotations: Array, translations: Array, origin: Array) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) and centres (M, 3): the inverse of `camera_from_local`."""
    inverse = np.ascontiguousarray(np.swapaxes(rotations, 1, 2))
    return inverse, origin - np.einsum("mij,mj->mi", inverse, translations)
