"""Rendering and appearance in torch against the CPU's: the same pictures, the same geometry."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from localizer.geometry.camera import Camera  # noqa: E402
from localizer.geometry.pose import Pose  # noqa: E402
from localizer.synth.appearance import model_torch as appearance_torch  # noqa: E402
from localizer.synth.appearance.model import (  # noqa: E402
    CONDITIONS,
    Appearance,
    apply_appearance,
    sample_appearance,
)
from localizer.synth.heightfield import render_torch as heightfield_torch  # noqa: E402
from localizer.synth.heightfield.render import render  # noqa: E402
from localizer.synth.heightfield.scene import Land, LitScene, Prism, SkyLight, compose, light_scene  # noqa: E402

N = 128


def scene(seed: int) -> LitScene:
    """Hills, a tower with windows, and texture, under a low sun."""
    rng = np.random.default_rng(seed)
    small = rng.standard_normal((9, 9)).astype(np.float32)
    height = cv2.resize(small, (N, N), interpolation=cv2.INTER_CUBIC) * 4
    albedo = rng.uniform(0.1, 0.9, (N, N, 3)).astype(np.float32)
    corners = np.array([[50, 50], [80, 50], [80, 75], [50, 75]], np.float32)
    prism = Prism(corners, 25.0, 0.0, (0.7, 0.2, 0.2), (0.8, 0.8, 0.7), 3.0)
    land = Land(height, albedo, 0.5 + 0.1 * seed)
    light = SkyLight((0.6, 0.3, 0.74), 0.9, 0.4)
    return light_scene(compose(land, [prism]), light, (0.5, 0.6, 0.7))


def looking(pitch_deg: float, yaw_deg: float) -> Pose:
    pitch, yaw = np.radians([pitch_deg, yaw_deg])
    flat = np.cos(pitch)
    forward = np.array([flat * np.cos(yaw), flat * np.sin(yaw), -np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    return Pose(rotation, np.array([32.0, 32.0, 5.0]) - 90.0 * forward)


VIEWS = [(88.0, 10.0), (45.0, 100.0), (25.0, 250.0)]  # the last one sees past the square's edge


@pytest.mark.parametrize("supersample", [1, 2])
def test_views_are_the_cpus(supersample: int) -> None:
    scenes = [scene(k) for k in range(2)]
    pool = heightfield_torch.ScenePool(2, N, torch.device("cpu"))
    for slot, lit in enumerate(scenes):
        pool.put(slot, lit)
    slots = [0, 1, 1]
    poses = [looking(*view) for view in VIEWS]
    cameras = [Camera.from_fov(96, 64, fov) for fov in (40.0, 60.0, 75.0)]
    images, depths = heightfield_torch.render(pool, slots, poses, cameras, supersample)
    walls = 0
    for k, (slot, pose, camera) in enumerate(zip(slots, poses, cameras, strict=True)):
        image, depth = render(scenes[slot], pose, camera, supersample)
        off = np.abs(depths[k].numpy() - depth) > 0.01
        # Rounding decides on which side of an edge a ray falls; nothing else may differ.
        assert off.mean() < 0.003
        assert (np.abs(images[k].numpy().astype(int) - image) > 2).any(-1).mean() < 0.006
        walls += int((np.abs(image.astype(int) - np.roll(image, 1, 1)) > 60).any(-1).sum())
    assert walls > 100  # the tower and its windows were in view


def photo(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    small = rng.integers(20, 230, (12, 16, 3), dtype=np.uint8)
    rgb = cv2.resize(small, (120, 88), interpolation=cv2.INTER_CUBIC)
    depth = np.linspace(400, 80, 88, dtype=np.float32)[:, None].repeat(120, 1)
    depth[:6] = 0.0
    return rgb, depth


def both(look: Appearance, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rgb, depth = photo(seed)
    expected = apply_appearance(rgb, depth, look, np.random.default_rng(seed))
    found = appearance_torch.apply_appearance(
        torch.from_numpy(rgb), torch.from_numpy(depth), look, np.random.default_rng(seed),
        torch.Generator().manual_seed(seed),
    )  # fmt: skip
    return expected, found.numpy()


@pytest.mark.parametrize("condition", CONDITIONS)
def test_weather_and_light_are_the_cpus(condition: str) -> None:
    for seed in range(6):
        look = replace(
            sample_appearance(np.random.default_rng(seed), condition),
            shot_noise=0.0, read_noise=0.0, jpeg_quality=100,
            motion_blur_px=3.5 * (seed % 2), defocus_px=0.8 * (seed % 3),
        )  # fmt: skip
        expected, found = both(look, seed)
        difference = np.abs(expected.astype(int) - found)
        assert difference.max() <= 2
        assert difference.mean() < 0.05


@pytest.mark.parametrize("quality", [25, 60, 95])
def test_jpeg_is_the_codecs(quality: int) -> None:
    rgb, _ = photo(1)
    coded = cv2.imencode(
        ".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )[1]
    expected = cv2.cvtColor(cv2.imdecode(coded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB).astype(int)
    found = appearance_torch.jpeg(torch.from_numpy(rgb).permute(2, 0, 1).float(), quality)
    difference = np.abs(expected - found.permute(1, 2, 0).numpy())
    assert difference.mean() < 0.25 * np.abs(expected - rgb).mean() + 0.3
