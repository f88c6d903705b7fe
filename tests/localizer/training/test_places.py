import numpy as np
import pytest

from localizer.synth.heightfield.scene import Land, LitScene, Prism, SkyLight, compose, light_scene
from localizer.synth.visits.visit import with_new_texture
from localizer.training.places.objects import coarse_mesh

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


def test_soft_ground_gets_another_texture_and_hard_ground_keeps_its_own(ground):
    albedo, lasting = ground
    for seed in range(4):
        fresh = with_new_texture(albedo, lasting, CELL, np.random.default_rng(seed))
        left, right = np.s_[:, : N // 2 - 20], np.s_[:, N // 2 + 20 :]
        assert likeness(albedo[right], fresh[right]) > 0.99
        assert likeness(albedo[left], fresh[left]) < 0.6
        # As strong as before, about.
        assert 0.5 < fresh[left].mean(-1).std() / albedo[left].mean(-1).std() < 2.0


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
