"""Flies the odometry along a stretch, with each source of depth, over the same pictures."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from benchmarks.odometry.stretches import TestStretch
from localizer.features.extractor import FeatureExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.odometry.config import OdometryConfig
from localizer.odometry.estimate import OdometryFrame
from localizer.odometry.ground import TerrainModel
from localizer.odometry.odometry import VisualOdometry
from localizer.odometry.usability import find_fault
from localizer.registration.anchors import select_anchors
from localizer.registration.jngo import JNGO
from localizer.render.base import MapRenderer
from localizer.synth.appearance.model import Appearance, apply_appearance, sample_appearance
from localizer.types import FeaturePyramid, GroundUncertainty, Image

DEPTHS = ("map", "ground", "plane", "range")
_BEGIN_M, _BEGIN_RAD = 0.1, float(np.radians(0.05))  # sigmas: the tracker's last good fix
_STARTED_NS = 1_000_000_000
_RANGE_SCALE, _RANGE_M, _RANGE_MISSED = 0.01, 0.1, 0.1  # a rangefinder's errors, readings lost
_BEAM, _DOWN = Camera.from_fov(8, 8, 1.0), np.diag([1.0, -1.0, -1.0])
_SURFACE = 4000  # points: anchors of a reference view, as configured for flight


Surface = Callable[[], Array | None] | None


@dataclass(frozen=True)
class OdometryStep:
    """One frame's outcome. error, covariance: of the position, world axes, m and m²; displacement:
    from the beginning, in a straight line; flown_m: along the true path.
    """

    status: str
    error: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    displacement: tuple[float, ...]
    flown_m: float
    drift_m: float
    quality: float
    keyframe_age_s: float
    ms: float


@dataclass(frozen=True)
class FlownStretch:
    """A stretch with one source of depth."""

    place: str
    condition: str
    seed: int
    depth: str
    steps: tuple[OdometryStep, ...]


@dataclass(frozen=True)
class FlownScene:
    """Where it is flown. seen: renders the world as it is; known: the map's geometry; ground: what
    it does not say of the ground.
    """

    name: str
    seen: MapRenderer
    known: MapRenderer
    camera: Camera
    terrain: TerrainModel | None
    ground: GroundUncertainty


class Flyer:
    """Flies stretches over a scene."""

    def __init__(
        self,
        scene: FlownScene,
        extractor: FeatureExtractor,
        optimizer: JNGO,
        config: OdometryConfig,
    ) -> None:
        self._scene, self._extractor = scene, extractor
        self._optimizer, self._config = optimizer, config

    def fly(self, stretch: TestStretch, depths: tuple[str, ...]) -> list[FlownStretch]:
        """The stretch with each source of depth in `depths`, over the same pictures."""
        rng = np.random.default_rng((stretch.seed, 2))
        begun, covariance = _beginning(stretch, rng)
        runs = [_OdometryRun(self._odometry(depth), depth, begun) for depth in depths]
        ranges = self._ranges(stretch) if "range" in depths else {}
        for k, frame in enumerate(self._frames(stretch, rng)):
            for run in runs:
                if k:
                    look = partial(self._surface, run.ahead) if run.depth == "map" else None
                    sounded = ranges.get(k) if run.depth == "range" else None
                    run.step(frame, look, sounded, stretch, k)
                else:
                    run.odometry.begin(
                        frame, begun, covariance, velocity=stretch.velocity,
                        surface=self._surface(begun), constraint=stretch.sensed[0],
                    )  # fmt: skip
        name = self._scene.name
        return [
            FlownStretch(name, stretch.condition, stretch.seed, run.depth, tuple(run.steps))
            for run in runs
        ]

    def _odometry(self, depth: str) -> VisualOdometry:
        scene = self._scene
        terrain = scene.terrain if depth == "ground" else None
        return VisualOdometry(
            scene.camera, self._optimizer, self._config, terrain, uncertainty=scene.ground
        )

    def _ranges(self, stretch: TestStretch) -> dict[int, float]:
        """A rangefinder's readings by number of the frame: what lies below in the seen world, roofs
        and crowns as well as ground.
        """
        rng = np.random.default_rng((stretch.seed, 3))
        scale, found = 1.0 + _RANGE_SCALE * rng.normal(), {}
        for k, pose in enumerate(stretch.poses):
            down = Pose(_DOWN, pose.translation)
            depth = self._scene.seen.render(down, _BEAM, wait=True).depth
            if depth.any() and rng.random() >= _RANGE_MISSED:
                # What reflects first, as laser altimeters report it.
                reading = scale * float(depth[depth > 0].min()) + _RANGE_M * rng.normal()
                found[k] = float(reading)
        return found

    def _frames(self, stretch: TestStretch, rng: np.random.Generator) -> Iterator[OdometryFrame]:
        look = sample_appearance(rng, stretch.condition)
        previous: Image | None = None
        for time_s, pose in zip(stretch.times_s, stretch.poses, strict=True):
            image = self._picture(pose, look, rng)
            time_ns = _STARTED_NS + round(time_s * 1e9)
            fault = find_fault(image, previous)
            yield OdometryFrame(self._extractor.extract(image), time_ns, fault)
            previous = image

    def _picture(self, pose: Pose, look: Appearance, rng: np.random.Generator) -> Image:
        """What the camera sees, from twice the resolution, under the stretch's light."""
        camera = self._scene.camera
        size = (camera.width, camera.height)
        view = self._scene.seen.render(pose, camera.resized(2 * size[0], 2 * size[1]), wait=True)
        rgb = cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        depth = cv2.resize(view.depth, size, interpolation=cv2.INTER_NEAREST).astype(np.float32)
        return apply_appearance(rgb, depth, look, rng)

    def _surface(self, pose: Pose) -> Array | None:
        """The points that the engine's reference at a predicted pose has anchors at."""
        camera = self._scene.camera
        view = self._scene.known.render(pose, camera, wait=True)
        without = FeaturePyramid((), camera.width, camera.height)
        points = select_anchors(view, without, _SURFACE).points_world
        return points if len(points) else None


class _OdometryRun:
    """One odometry on its way. ahead: where the next frame is expected."""

    def __init__(self, odometry: VisualOdometry, depth: str, begun: Pose) -> None:
        self.odometry, self.depth, self.ahead = odometry, depth, begun
        self.steps: list[OdometryStep] = []
        self._begun = self._last = begun

    def step(
        self, frame: OdometryFrame, surface: Surface, clearance_m: float | None,
        stretch: TestStretch, k: int,
    ) -> None:  # fmt: skip
        """Carry on by one frame, and measure it."""
        started = time.perf_counter()
        estimate = self.odometry.step(
            frame, surface=surface, constraint=stretch.sensed[k], clearance_m=clearance_m
        )
        ms = (time.perf_counter() - started) * 1e3
        found = estimate.world_from_camera
        moved = found.translation - self._last.translation
        self.ahead, self._last = Pose(found.rotation, found.translation + moved), found
        self.steps.append(
            OdometryStep(
                estimate.status.name,
                tuple(found.translation - stretch.poses[k].translation),
                tuple(tuple(float(x) for x in row) for row in estimate.covariance[:3, :3]),
                tuple(found.translation - self._begun.translation),
                stretch.flown_m(k),
                estimate.drift_m,
                estimate.quality,
                estimate.keyframe_age_s,
                ms,
            )
        )


def _beginning(stretch: TestStretch, rng: np.random.Generator) -> tuple[Pose, Array]:
    """The tracker's last good fix, with its error and covariance."""
    true, sigma = stretch.poses[0], np.repeat([_BEGIN_M, _BEGIN_RAD], 3)
    error = rng.normal(0, sigma)
    begun = Pose(so3_exp(error[3:]) @ true.rotation, true.translation + error[:3])
    return begun, np.diag(sigma**2)
