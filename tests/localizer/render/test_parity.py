"""One suite for every backend: depth against analytic rays, colour against the CPU renderer."""

# ruff: noqa: RUF005 (sums of arrays are meant, not lists)

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from localizer.errors import RenderError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose, so3_exp
from localizer.map.cache.pick import cast_rays
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.render.base import StaticTiles
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.select import make_renderer, open_renderer
from localizer.types import RenderedView

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
CAMERA = Camera(256, 192, 230.0, 235.0, 121.7, 99.2)
POSES = {
    "nadir": Pose(DOWN, np.array([3.0, -4.0, 120.0])),
    "oblique": Pose(so3_exp([0.8, 0.1, 0.2]) @ DOWN, np.array([0.0, -110.0, 90.0])),
    "horizon": Pose(so3_exp([1.35, 0.0, -0.4]) @ DOWN, np.array([10.0, -60.0, 30.0])),
}


def photo(seed: int, size: int = 512) -> np.ndarray:
    """Smooth blobs with some detail, like an orthophoto."""
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size, 3), np.float32)
    for cells, weight in ((6, 120), (40, 60), (160, 25)):
        noise = rng.random((cells, cells, 3), dtype=np.float32)
        total += weight * cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(total + 20, 0, 255).astype(np.uint8)


def scene() -> list[TileMesh]:
    """Four turned tiles of hills with boxes, far from the world's origin."""
    turned = so3_exp([0.02, -0.01, 0.7])
    rng = np.random.default_rng(7)
    meshes = []
    for i, (west, south) in enumerate([(-100, -100), (0, -100), (-100, 0), (0, 0)]):
        s = np.linspace(0, 100, 41)
        x, y = np.meshgrid(s, s[::-1])
        z = 4 * np.sin((x + west) / 15) + 3 * np.cos((y + south) / 11)
        for _ in range(8):
            a, b = rng.uniform(5, 85, 2)
            z[(x > a) & (x < a + 10) & (y > b) & (y < b + 12)] += rng.uniform(5, 20)
        uv = np.stack([x / 100, 1 - y / 100], -1).reshape(-1, 2)
        j = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
        faces = [np.stack([j, j + 41, j + 1], 1), np.stack([j + 1, j + 41, j + 42], 1)]
        meshes.append(
            TileMesh(
                (np.stack([x, y, z], -1).reshape(-1, 3) @ turned).astype(np.float32),
                uv.astype(np.float32),
                np.concatenate(faces).astype(np.int32),
                build_mips(photo(i)),
                Pose(turned, np.array([5000.0 + west, -2000.0 + south, 50.0])),
            )
        )
    return meshes


WORLD = Pose(np.eye(3), np.array([5000.0, -2000.0, 50.0]))
MESHES = scene()


@pytest.fixture(params=["numba", "moderngl", "pyrender"])
def renderer(request):
    try:
        made = make_renderer(request.param, StaticTiles(MESHES))
    except RenderError as error:
        pytest.skip(str(error))
    yield made
    made.close()


def away_from_silhouettes(depth: np.ndarray) -> np.ndarray:
    """Pixels whose neighbourhood has no jump in depth."""
    kernel = np.ones((5, 5), np.uint8)
    high, low = cv2.dilate(depth, kernel), cv2.erode(depth, kernel)
    return (low > 0) & (high < 1.05 * low)


@pytest.mark.parametrize("name", POSES)
def test_depth_against_analytic_rays(renderer, name):
    view = WORLD @ POSES[name]
    depth = renderer.render(view, CAMERA).depth
    v, u = np.mgrid[0:192:3, 0:256:3]
    rays = CAMERA.rays(np.stack([u + 0.5, v + 0.5], -1).reshape(-1, 2))
    truth = cast_rays(MESHES, view.translation, rays @ view.rotation.T)
    drawn = depth[v, u].ravel()
    assert ((drawn > 0) != np.isfinite(truth)).mean() < 2e-3
    keep = away_from_silhouettes(depth)[v, u].ravel() & (drawn > 0) & np.isfinite(truth)
    error = np.abs(drawn - truth)[keep]
    assert keep.mean() > 0.25
    assert np.median(error) <= 1e-3
    assert np.percentile(error, 99.9) <= 2e-2


@pytest.mark.parametrize("name", POSES)
def test_colour_against_the_cpu_renderer(renderer, name):
    view = WORLD @ POSES[name]
    reference = NumbaRenderer(StaticTiles(MESHES), threads=1)
    ours, theirs = reference.render(view, CAMERA), renderer.render(view, CAMERA)
    keep = away_from_silhouettes(ours.depth) & (theirs.depth > 0)
    difference = np.abs(ours.rgb.astype(int) - theirs.rgb).max(axis=-1)[keep]
    assert np.median(difference) <= 1
    # Where the footprint is at the border between two mips, backends may choose differently.
    assert (difference <= 2).mean() >= 0.98


def test_sky_and_size(renderer):
    up = Pose(so3_exp([np.pi, 0, 0]) @ DOWN, WORLD.translation + [0, 0, 100])
    view = renderer.render(up, Camera.from_fov(64, 48, 60))
    assert view.rgb.shape == (48, 64, 3)
    assert view.depth.dtype == np.float32
    assert (view.depth == 0).all()
    assert np.abs(view.rgb.astype(int) - (176, 196, 216)).max() <= 1


def test_near_plane(renderer):
    level = Pose(so3_exp([np.pi / 2, 0, 0]) @ DOWN, WORLD.translation + [20.0, -95.0, 9.0])
    view = renderer.render(level, CAMERA)
    reference = NumbaRenderer(StaticTiles(MESHES), threads=1).render(level, CAMERA)
    keep = away_from_silhouettes(reference.depth)
    assert keep.mean() > 0.2
    assert np.abs(view.depth - reference.depth)[keep].max() < 0.05


def test_moving_objects_and_results_of_ones_own(renderer):
    camera = Camera.from_fov(64, 64, 60)
    view = WORLD @ Pose(DOWN, np.array([0.0, 0.0, 150.0]))
    first = renderer.render(view, camera)
    kept = first.rgb.copy(), first.depth.copy()
    car = TileMesh(
        np.array([[-9, -9, 0], [9, -9, 0], [-9, 9, 0], [9, 9, 0]], np.float32),
        np.zeros((4, 2), np.float32),
        np.array([[0, 1, 2], [1, 3, 2]], np.int32),
        (np.full((4, 4, 3), (250, 0, 0), np.uint8),),
        Pose(np.eye(3), WORLD.translation + [0, 0, 60]),
    )
    second = renderer.render(view, camera, [car])
    assert second.depth[32, 32] == pytest.approx(90, abs=0.01)
    assert np.abs(second.rgb[32, 32].astype(int) - (250, 0, 0)).max() <= 2
    third = renderer.render(view, camera, [car.placed(Pose(np.eye(3), np.zeros(3)))])
    assert np.array_equal(third.depth, kept[1])
    assert np.array_equal(first.rgb, kept[0])


def test_an_opengl_renderer_refuses_other_threads():
    try:
        renderer = make_renderer("moderngl", StaticTiles(MESHES))
    except RenderError as error:
        pytest.skip(str(error))
    caught: list[Exception] = []

    def use() -> None:
        try:
            renderer.render(WORLD @ POSES["nadir"], CAMERA)
        except RenderError as error:
            caught.append(error)

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    renderer.close()
    assert "thread" in str(caught[0])


def test_an_opened_opengl_renderer_may_be_used_by_any_thread():
    before = threading.active_count()
    try:
        renderer = open_renderer("moderngl", StaticTiles(MESHES))
    except RenderError as error:
        assert threading.active_count() == before
        pytest.skip(str(error))
    assert renderer.name.startswith("moderngl (")
    views: list[RenderedView] = []

    def use() -> None:
        renderer.warm_up()
        views.append(renderer.render(WORLD @ POSES["nadir"], CAMERA))

    for _ in range(2):
        thread = threading.Thread(target=use)
        thread.start()
        thread.join()
    views.append(renderer.render(WORLD @ POSES["nadir"], CAMERA))
    renderer.close()
    reference = NumbaRenderer(StaticTiles(MESHES), threads=1)
    depth = reference.render(WORLD @ POSES["nadir"], CAMERA).depth
    keep = away_from_silhouettes(depth)
    for view in views:
        assert np.abs(view.depth - depth)[keep].max() < 0.02


def test_auto_never_chooses_software_opengl():
    for make in (make_renderer, open_renderer):
        renderer = make("auto", StaticTiles(MESHES))
        assert "llvmpipe" not in renderer.name
        renderer.close()


@pytest.mark.gpu
@pytest.mark.skipif(not Path("/dev/nvidia0").exists(), reason="no GPU device")
def test_auto_chooses_the_gpu():
    renderer = make_renderer("auto", StaticTiles(MESHES))
    name = renderer.name
    renderer.close()
    assert name.startswith("moderngl")
