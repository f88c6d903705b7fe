"""Keyframes: an earlier frame's features with known 3-D positions."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from localizer.device_array import DeviceArray
from localizer.errors import DeviceArrayError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.geometry.shutter import Sweep
from localizer.odometry.ground import TerrainModel, ground_points
from localizer.odometry.growth import add_scale_error
from localizer.registration.anchors import anchors_at
from localizer.registration.priors import PoseConstraint
from localizer.types import Anchors, FeaturePyramid

_BORDER_SHARE = 0.02  # of the shorter side, where features see the padding
_CELLS = 12  # per shorter side: what the map covers is told by cells of this size
_LEAST_MAP_SHARE = 0.5  # of the anchors, for errors to grow as with the map's geometry


class DepthSource(Enum):
    """Main source of a keyframe's depth."""

    MAP = "the map's geometry"
    GROUND = "the ground's height"
    RANGE = "the ground as a rangefinder met it"
    PLANE = "level ground"


@dataclass(frozen=True)
class Keyframe:
    """A frame that later frames are registered against.

    anchors: its features at world points, as the map registration's. covariance: (6, 6) of its
    pose, as `PosePrior`'s. source: source of its depth. way_m: distance flown up to it. constraint:
    other sensors' measurement of its pose. features, camera, surface: the inputs of its anchors.
    scale: relative sigma of the height above its points. scale_covariance: (3, 3) covariance of the
    position from all scale errors so far. unmatched_m2: variance from frames that did not match so
    far (`GrowthModel.unmatched`).
    """

    anchors: Anchors
    world_from_camera: Pose
    covariance: Array
    time_ns: int
    source: DepthSource
    way_m: float
    features: FeaturePyramid
    camera: Camera
    surface: Array | None = None
    constraint: PoseConstraint | None = None
    scale: float = 0.0
    scale_covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    unmatched_m2: float = 0.0

    def scale_covariance_at(self, pose: Pose) -> Array:
        """`scale_covariance` of a pose that was measured against this one."""
        hop = pose.translation - self.world_from_camera.translation
        return add_scale_error(self.scale_covariance, self.scale, hop)


def keyframe_anchors(  # noqa: PLR0913
    features: FeaturePyramid,
    camera: Camera,
    world_from_camera: Pose,
    surface: Array | None,
    ground: TerrainModel | None,
    count: int,
    seed: int = 0,
    sweep: Sweep | None = None,
) -> tuple[Anchors, DepthSource]:
    """Anchors of an earlier frame, at most about `count`, and MAP if over half of them have their
    depth from `surface`, otherwise GROUND.

    surface: points (N, 3) on the map's surfaces, away from edges: the anchors of the map view that
    was rendered for this frame. ground: gives points where the map has none. Without both there are
    no anchors. sweep: the camera's motion during the exposure, see `OdometryFrame`.
    `DeviceArrayError` for features in GPU memory.
    """
    _require_host(features)
    rng = np.random.default_rng(seed)
    points, pixels = np.zeros((0, 3)), np.zeros((0, 2))
    if surface is not None:
        points, pixels = in_view(surface, world_from_camera, camera, sweep)
        if len(points) > count:
            chosen = np.sort(rng.choice(len(points), count, replace=False))
            points, pixels = points[chosen], pixels[chosen]
    mapped = len(points)
    if ground is not None:
        free = _uncovered(pixels, camera, count, rng)
        below, met = ground_points(ground, world_from_camera, camera, free)
        points = np.concatenate([points, below[met]])
        pixels = np.concatenate([pixels, free[met]])
    source = DepthSource.MAP if mapped > _LEAST_MAP_SHARE * len(points) else DepthSource.GROUND
    return anchors_at(points, pixels, features), source


def _require_host(features: FeaturePyramid) -> None:
    if any(isinstance(level.features, DeviceArray) for level in features.levels):
        raise DeviceArrayError(
            "a keyframe outlives its frame, and these features lie on the GPU until the next one: "
            "give the odometry features that were extracted to the host"
        )


def in_view(
    points: Array, pose: Pose, camera: Camera, sweep: Sweep | None = None
) -> tuple[Array, Array]:
    """The points (N, 3) that the camera sees inside its border, with their pixels.

    sweep: the camera's motion while its rows are read out; None: a global shutter.
    """
    seen = points if sweep is None else sweep.apparent_points(points, pose, camera)
    pixels, inside = camera.project(pose.inverse.apply(seen))
    pixels, points = pixels[inside], points[inside]
    border = max(2.0, _BORDER_SHARE * min(camera.width, camera.height))
    size = np.array([camera.width, camera.height])
    off = np.all((pixels >= border) & (pixels <= size - border), axis=1)
    return points[off], pixels[off]


def _uncovered(pixels: Array, camera: Camera, count: int, rng: np.random.Generator) -> Array:
    """About `count` random pixels over the whole image, without those in a cell that contains one
    of `pixels` (N, 2).
    """
    side = min(camera.width, camera.height) / _CELLS
    border = max(2.0, _BORDER_SHARE * min(camera.width, camera.height))
    step = np.sqrt(camera.width * camera.height / count)
    v, u = np.mgrid[border : camera.height - border : step, border : camera.width - border : step]
    drawn = np.stack([u.ravel(), v.ravel()], axis=1) + rng.uniform(0, step, (u.size, 2))
    limit = np.array([camera.width, camera.height]) - border
    drawn = drawn[np.all(drawn <= limit, axis=1)]
    covered = np.zeros((_CELLS * 8, _CELLS * 8), dtype=bool)
    covered[tuple((pixels // side).astype(np.int64).T)] = True
    free: Array = drawn[~covered[tuple((drawn // side).astype(np.int64).T)]]
    return free
