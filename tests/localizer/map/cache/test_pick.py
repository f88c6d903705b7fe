"""Picking: sub-pixel depth on planes, no invented points at edges, exact with triangles."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.pick import cast_rays, pick
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.render.numba_raster import NumbaRenderer

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)


def square(size, z) -> TileMesh:
    s = size / 2
    positions = np.array([[-s, s, z], [s, s, z], [-s, -s, z], [s, -s, z]], np.float32)
    faces = np.array([[0, 2, 1], [1, 2, 3]], np.int32)
    mips = build_mips(np.zeros((8, 8, 3), np.uint8))
    return TileMesh(positions, np.zeros((4, 2), np.float32), faces, mips, Pose.identity())


GROUND, ROOF = square(600, 0.0), square(20, 30.0)


@pytest.fixture(scope="module")
def view():
    renderer = NumbaRenderer(SimpleNamespace(), threads=1)
    pose = Pose(so3_exp([0.5, 0.1, 0.0]) @ DOWN, np.array([2.0, -60.0, 100.0]))
    return renderer.draw([GROUND, ROOF], pose, CAMERA)


def pixels_of(view, points):
    return CAMERA.project(view.world_from_camera.inverse.apply(points))[0]


def test_depth_is_exact_on_planes_between_pixel_centres(view):
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(20, 40, 200), rng.uniform(-35, -12, 200), np.zeros(200)])
    points, valid = pick(view, pixels_of(view, ground))
    assert valid.all()
    assert np.abs(points - ground).max() < 2e-3


def test_no_point_hangs_between_roof_and_ground(view):
    edge = np.column_stack([np.linspace(-12, 12, 400), np.zeros(400), np.full(400, 30.0)])
    points, valid = pick(view, pixels_of(view, edge))
    on_ground, on_roof = np.abs(points[:, 2]) < 1.0, np.abs(points[:, 2] - 30) < 1.0
    assert valid.all()
    assert (on_ground | on_roof).all()
    assert on_ground.any()
    assert on_roof.any()


def test_triangles_decide_at_edges_exactly(view):
    for east, z in ((9.98, 30.0), (10.02, 0.0)):
        pixel = pixels_of(view, [[east, 0.0, 30.0]])
        points, valid = pick(view, pixel, [GROUND, ROOF])
        assert valid.all()
        assert points[0, 2] == pytest.approx(z, abs=1e-6)


def test_sky_outside_and_nan_pixels_are_not_valid(view):
    pixels = [[-1.0, 5.0], [500.0, 5.0], [np.nan, 3.0]]
    for meshes in ((), (GROUND,)):
        _, valid = pick(view, pixels, meshes)
        assert not valid[0 if not meshes else 2]
    level = view.world_from_camera.rotation @ so3_exp([1.5, 0, 0])
    assert np.isnan(cast_rays([GROUND], [0, 0, 10], level[:, 2] * [0, 0, 1] + [0, 0, 1]))
