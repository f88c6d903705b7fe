from dataclasses import replace

import cv2
import numpy as np
import pytest

from localizer.synth.heightfield.scene import Land, LitScene, Prism, SkyLight, compose, light_scene
from localizer.synth.visits.texture import coarser, draw_texel, hard_surfaces, regrown, wetted
from localizer.training.places.changes import coarse_mesh, plain_walls

N, CELL = 256, 0.3


@pytest.fixture
def ground() -> tuple[np.ndarray, np.ndarray]:
    """Fine random texture, and a mask that lasts on the right half."""
    rng = np.random.default_rng(0)
    albedo = np.clip(0.4 + 0.08 * rng.standard_normal((N, N, 1)), 0.05, 1)
    albedo = np.repeat(albedo, 3, 2).astype(np.float32)
    lasting = np.zeros((N, N), np.float32)
    lasting[:, N // 2 :] = 1.0
    return albedo, lasting


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.mean(-1).ravel(), b.mean(-1).ravel())[0, 1])


def test_soft_ground_gets_another_texture_and_hard_ground_keeps_its_own(
    ground: tuple[np.ndarray, np.ndarray],
) -> None:
    albedo, lasting = ground
    for seed in range(4):
        fresh = regrown(albedo, lasting, CELL, np.random.default_rng(seed))
        left, right = np.s_[:, : N // 2 - 20], np.s_[:, N // 2 + 20 :]
        assert likeness(albedo[right], fresh[right]) > 0.99
        assert likeness(albedo[left], fresh[left]) < 0.6
        # As strong as before, about.
        assert 0.5 < fresh[left].mean(-1).std() / albedo[left].mean(-1).std() < 2.0


def test_what_is_coarse_lasts(ground: tuple[np.ndarray, np.ndarray]) -> None:
    albedo, lasting = ground
    fields = cv2.resize(np.random.default_rng(1).uniform(0.2, 0.8, (4, 4)), (N, N))[..., None]
    fresh = regrown((0.3 * albedo + fields).astype(np.float32), 0 * lasting, CELL,
                    np.random.default_rng(2))  # fmt: skip
    assert likeness(np.repeat(fields, 3, 2), cv2.GaussianBlur(fresh, (0, 0), 8)) > 0.95


def test_wetness_touches_hard_surfaces_only(ground: tuple[np.ndarray, np.ndarray]) -> None:
    albedo, lasting = ground
    wet = wetted(albedo, lasting, np.random.default_rng(3))
    np.testing.assert_array_equal(wet[:, : N // 2], albedo[:, : N // 2])
    assert np.abs(wet - albedo)[:, N // 2 :].mean() > 0.005


def scene() -> LitScene:
    prism = Prism(np.float32([[100, 100], [150, 100], [150, 140], [100, 140]]), 9.0, 0.0,
                  (0.5, 0.4, 0.4), (0.6, 0.6, 0.6), 3.0)  # fmt: skip
    land = Land(np.zeros((N, N), np.float32), np.full((N, N, 3), 0.4, np.float32), CELL)
    return light_scene(compose(land, [prism]), SkyLight((0.3, 0.2, 0.9), 0.7, 0.5), (1, 1, 1))


def test_a_coarse_mesh_is_rounded_and_bounded_from_above() -> None:
    true = scene()
    for seed in range(4):
        mesh = coarse_mesh(true, np.random.default_rng(seed))
        flat = np.s_[180:, 180:]
        assert 0.005 < np.abs(mesh.height[flat] - true.height[flat]).mean() < 0.5
        assert np.abs(np.diff(mesh.height)).max() < 9.5
        blocks = mesh.height.reshape(N // 16, 16, N // 16, 16).max((1, 3))
        assert (mesh.block_max >= blocks).all()  # else the ray marcher would step over it


def test_a_coarser_image_has_fewer_details() -> None:
    image = np.random.default_rng(4).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    assert coarser(image, 1.0) is image
    assert coarser(image, 3.0).shape == image.shape
    assert coarser(image, 3.0).std() < 0.5 * image.std()
    texels = [draw_texel(np.random.default_rng(k)) for k in range(50)]
    assert min(texels) >= 1.0
    assert max(texels) <= 4.0


def test_hard_surfaces_are_told_from_vegetation_and_soil() -> None:
    colors = {"asphalt": (110, 110, 112), "tiles": (170, 90, 70), "grass": (90, 120, 60),
              "straw": (170, 150, 100)}  # fmt: skip
    image = np.repeat(np.uint8([list(colors.values())]), 32, 0).repeat(16, 1)
    mask = hard_surfaces(np.ascontiguousarray(image))[16, 8::16]
    assert dict(zip(colors, mask > 0.5, strict=True)) == {
        "asphalt": True, "tiles": True, "grass": False, "straw": False
    }  # fmt: skip


def test_plain_walls_have_no_windows() -> None:
    prism = Prism(np.zeros((4, 2), np.float32), 3.0, 1.0, (1, 1, 1), (1, 1, 1), 2.0)
    assert plain_walls([prism]) == [replace(prism, window_m=0.0)]
