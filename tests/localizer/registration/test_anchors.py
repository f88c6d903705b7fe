from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localizer.registration.anchors import morton_code, select_anchors
from localizer.registration.backend import sample_bilinear
from localizer.registration.cpu.reference import feature_gradients
from localizer.registration.sampling import sample_features, structure_tensors


@pytest.fixture(scope="module")
def reference(place, camera, scene):
    return place.view(scene.reference, camera), place.pyramid(scene.reference, camera)


def test_anchors_lie_on_the_ground(reference, place):
    anchors = select_anchors(*reference)
    x, y, z = anchors.points_world.T
    np.testing.assert_allclose(z, place.height(x, y), atol=1e-3)


def test_spread_over_the_whole_view(reference, camera):
    """Every cell of a 4 x 4 split gets its share, within a third."""
    anchors = select_anchors(reference[0], reference[1], count=480)
    columns = (anchors.pixels[:, 0] * 4 // camera.width).astype(int)
    rows = (anchors.pixels[:, 1] * 4 // camera.height).astype(int)
    counts = np.bincount(rows * 4 + columns, minlength=16)
    assert counts.min() >= 20
    assert counts.max() <= 40


def test_no_anchor_near_holes_and_depth_edges(reference):
    view, pyramid = reference
    depth = view.depth.copy()
    depth[:40] = 0.0
    depth[70:100, 50:90] -= 15.0  # a flat roof
    anchors = select_anchors(replace(view, depth=depth), pyramid)
    u, v = anchors.pixels.T
    assert v.min() > 42
    across = (v > 68) & (v < 102)
    for edge in (50, 90):
        assert not np.any(across & (np.abs(u - edge) < 2))
    assert np.any((v > 72) & (v < 98) & (u > 52) & (u < 88))


def test_a_steep_plane_is_no_depth_edge(camera, scene, reference):
    """1/depth of a plane is linear in the pixel, however grazing the view."""
    view, pyramid = reference
    v, _ = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    down = np.radians(8.0) + np.arctan((v - camera.cy) / camera.fy)
    depth = np.where(down > 0.02, 100.0 / np.sin(down) * np.cos(down - np.radians(8.0)), 0.0)
    anchors = select_anchors(replace(view, depth=depth.astype(np.float32)), pyramid)
    top = anchors.pixels[:, 1].min()
    horizon = np.flatnonzero(depth[:, 0] > 0)[0]
    assert top < horizon + 8


def test_view_of_nothing_gives_no_anchors(reference):
    view, pyramid = reference
    anchors = select_anchors(replace(view, depth=np.zeros_like(view.depth)), pyramid)
    assert anchors.points_world.shape == (0, 3)


def test_compiled_sampling_is_the_references(reference):
    rng = np.random.default_rng(0)
    level = reference[1].levels[1]
    x, y = rng.uniform(-3, 40, 500), rng.uniform(-3, 40, 500)
    exact = sample_bilinear(level.features, x, y)
    np.testing.assert_allclose(sample_features(level.features, x, y), exact, atol=1e-6)


def test_compiled_structure_is_the_references(reference):
    rng = np.random.default_rng(0)
    level = reference[1].levels[1]
    h, w, channels = level.features.shape
    x, y = rng.uniform(0, w - 1.01, 200), rng.uniform(0, h - 1.01, 200)
    anchors = rng.normal(size=(200, channels)).astype(np.float32)
    gradient = np.stack(feature_gradients(level.features, x, y), axis=1)
    residual = sample_bilinear(level.features, x, y) - anchors
    tensors, slopes, squares = structure_tensors(level.features, anchors, x, y)
    np.testing.assert_allclose(tensors, gradient @ gradient.transpose(0, 2, 1), atol=1e-5)
    np.testing.assert_allclose(slopes, np.einsum("nkc,nc->nk", gradient, residual), atol=1e-5)
    np.testing.assert_allclose(squares, (residual**2).sum(axis=1), rtol=1e-5)


def test_morton_code_interleaves_bits():
    x, y = np.random.default_rng(0).integers(0, 1 << 16, (2, 50))
    bits = [f"{b:016b}" for b in x], [f"{b:016b}" for b in y]
    wanted = [
        int("".join(q + p for p, q in zip(*pair, strict=True)), 2)
        for pair in zip(*bits, strict=True)
    ]
    np.testing.assert_array_equal(morton_code(x, y), wanted)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("pattern", [0x7FA00000, 0x7FC00000, 0xFF800000, 0x7F7FFFFF, 1, 0x80000000])
def test_what_is_no_depth_is_a_hole_without_a_warning(reference, pattern):
    """Signalling NaN, NaN, -inf, the largest and the smallest number, -0."""
    view, pyramid = reference
    depth = view.depth.copy()
    depth.view(np.uint32)[60:64, 80:84] = pattern
    anchors = select_anchors(replace(view, depth=depth), pyramid)
    assert np.isfinite(anchors.points_world).all()
    u, v = anchors.pixels.T
    assert not np.any((np.abs(u - 82) < 3) & (np.abs(v - 62) < 3))
    whole = select_anchors(view, pyramid)
    assert len(anchors.pixels) == len(whole.pixels)
