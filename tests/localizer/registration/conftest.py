"""A synthetic place with features known in closed form: nothing is rendered or blurred."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose, so3_exp
from localizer.registration.anchors import select_anchors
from localizer.types import Anchors, FeatureLevel, FeaturePyramid, PosePrior, RenderedView

STRIDES = (8, 4, 2)
CHANNELS = 16


@dataclass(frozen=True)
class SyntheticPlace:
    """A hilly ground with random smooth feature fields, one per pyramid level.

    hills: (K, 4) amplitude, wave numbers and phase of the height; waves: per level (C, W, 3) wave
    numbers and phases. A coarser level has longer waves, as a network's has.
    """

    hills: Array
    waves: tuple[Array, ...]

    @classmethod
    def from_seed(cls, seed: int, relief_m: float = 6.0) -> SyntheticPlace:
        rng = np.random.default_rng(seed)
        angle = rng.uniform(0, 2 * np.pi, 4)
        k = 2 * np.pi / rng.uniform(60, 150, 4)
        hills = np.stack(
            [
                rng.uniform(0.3, 1.0, 4) * relief_m / 2,
                k * np.cos(angle),
                k * np.sin(angle),
                rng.uniform(0, 2 * np.pi, 4),
            ],
            axis=1,
        )
        waves = []
        for shortest in (30.0, 15.0, 8.0):
            k = 2 * np.pi / rng.uniform(shortest, 2.5 * shortest, (CHANNELS, 6))
            angle = rng.uniform(0, 2 * np.pi, (CHANNELS, 6))
            phase = rng.uniform(0, 2 * np.pi, (CHANNELS, 6))
            waves.append(np.stack([k * np.cos(angle), k * np.sin(angle), phase], axis=-1))
        return cls(hills, tuple(waves))

    def height(self, x: Array, y: Array) -> Array:
        a, kx, ky, phase = self.hills.T
        total: Array = (a * np.sin(x[..., None] * kx + y[..., None] * ky + phase)).sum(-1)
        return total

    def features(self, level: int, x: Array, y: Array) -> Array:
        """Unit features (..., C) of ground points."""
        w = self.waves[level]
        values = np.empty((*x.shape, CHANNELS))
        for c in range(CHANNELS):
            kx, ky, phase = w[c].T
            values[..., c] = np.sin(x[..., None] * kx + y[..., None] * ky + phase).sum(-1)
        values += 0.5
        unit: Array = values / np.linalg.norm(values, axis=-1, keepdims=True)
        return unit

    def hit(self, pose: Pose, camera: Camera, pixels: Array) -> Array:
        """Depth z (...) along the rays of pixels (..., 2), by fixed-point iteration."""
        rays = camera.rays(pixels) @ pose.rotation.T
        depth = -pose.translation[2] / rays[..., 2]
        for _ in range(25):
            point = pose.translation + rays * depth[..., None]
            depth = (
                depth + (self.height(point[..., 0], point[..., 1]) - point[..., 2]) / rays[..., 2]
            )
        return np.asarray(depth)

    def pyramid(
        self, pose: Pose, camera: Camera, noise: float = 0.0, seed: int = 0
    ) -> FeaturePyramid:
        rng = np.random.default_rng(seed)
        levels = []
        for k, stride in enumerate(STRIDES):
            v, u = np.mgrid[0 : camera.height // stride, 0 : camera.width // stride]
            pixels = (np.stack([u, v], axis=-1) + 0.5) * stride
            depth = self.hit(pose, camera, pixels)
            point = pose.apply(camera.rays(pixels) * depth[..., None])
            f = self.features(k, point[..., 0], point[..., 1])
            f = f + noise * rng.standard_normal(f.shape)
            f /= np.linalg.norm(f, axis=-1, keepdims=True)
            confidence = rng.uniform(0.5, 0.9, f.shape[:2])
            levels.append(
                FeatureLevel(
                    np.ascontiguousarray(f, np.float32), confidence.astype(np.float32), stride
                )
            )
        return FeaturePyramid(tuple(levels), camera.width, camera.height)

    def view(self, pose: Pose, camera: Camera) -> RenderedView:
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        depth = self.hit(pose, camera, np.stack([u, v], axis=-1) + 0.5)
        rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
        return RenderedView(rgb, depth.astype(np.float32), pose, camera)


@dataclass(frozen=True)
class Scene:
    """One registration problem with its truth."""

    place: SyntheticPlace
    camera: Camera
    true: Pose
    reference: Pose
    anchors: Anchors
    query: FeaturePyramid


def make_scene(
    place: SyntheticPlace, camera: Camera, seed: int, shift_m: float, turn_deg: float
) -> Scene:
    """A query from a random pose, and anchors of a view that many metres and degrees away."""
    rng = np.random.default_rng(seed)
    position = np.array([*rng.uniform(-80, 80, 2), rng.uniform(90, 130)])
    true = camera_pose(position, rng.uniform(50, 90), rng.uniform(0, 360))
    reference = perturbed(true, shift_m, turn_deg, seed)
    pyramid = place.pyramid(reference, camera, 0.05, seed)
    anchors = select_anchors(place.view(reference, camera), pyramid, 300, seed)
    return Scene(
        place, camera, true, reference, anchors, place.pyramid(true, camera, 0.05, seed + 1)
    )


def camera_pose(position: Array, down_deg: float, heading_deg: float) -> Pose:
    """A camera that looks `down_deg` below the horizon, image x horizontal."""
    p, h = np.radians([down_deg, heading_deg])
    z = np.array([np.cos(p) * np.sin(h), np.cos(p) * np.cos(h), -np.sin(p)])
    x = np.array([np.cos(h), -np.sin(h), 0.0])
    return Pose(np.column_stack([x, np.cross(z, x), z]), np.asarray(position, dtype=np.float64))


def perturbed(pose: Pose, translation_m: float, rotation_deg: float, seed: int) -> Pose:
    """The pose moved by exactly these magnitudes in a random direction."""
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((2, 3))
    turn = so3_exp(np.radians(rotation_deg) * a / np.linalg.norm(a))
    return Pose(turn @ pose.rotation, pose.translation + translation_m * b / np.linalg.norm(b))


def prior_about(pose: Pose, sigma_m: float, sigma_deg: float) -> PosePrior:
    sigma = np.radians(sigma_deg)
    return PosePrior(pose, np.diag([sigma_m**2] * 3 + [sigma**2] * 3), 0)


@pytest.fixture(scope="session")
def place() -> SyntheticPlace:
    return SyntheticPlace.from_seed(7)


@pytest.fixture(scope="session")
def camera() -> Camera:
    """Off-centre principal point and unequal focal lengths, so that neither can be mixed up."""
    return Camera(160, 120, 150.0, 144.0, 76.0, 63.5)


@pytest.fixture(scope="session")
def scene(place: SyntheticPlace, camera: Camera) -> Scene:
    return make_scene(place, camera, 11, 2.0, 1.5)


@pytest.fixture(scope="session")
def scene_factory(place: SyntheticPlace, camera: Camera) -> Callable[..., Scene]:
    return lambda seed, shift_m, turn_deg, at=place: make_scene(at, camera, seed, shift_m, turn_deg)


@pytest.fixture(scope="session")
def prior() -> Callable[[Pose, float, float], PosePrior]:
    return prior_about
