"""The whole way of a generated world, from tileset to rendered view, against its own plan."""

import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.building.build import build_cache
from localizer.map.building.options import BuildOptions
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import (
    CONDITIONS,
    Appearance,
    apply_appearance,
    sample_appearance,
)
from localizer.synth.tiles.vegetation import car_mesh

NADIR = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # x east, y south, z down
CAMERA = Camera.from_fov(320, 240, 60.0)


@pytest.fixture(scope="module")
def renderer(small_world, tmp_path_factory):
    folder, info = small_world["survey"]
    out = tmp_path_factory.mktemp("cache") / "map"
    manifest = build_cache(
        folder / "tileset.json", out, BuildOptions(origin=info.origin, workers=1)
    )
    assert manifest.geoid_separation_m == info.geoid_separation_m
    streamer = TileStreamer(TileCache.open(out))
    yield NumbaRenderer(streamer, threads=1)
    streamer.close()


def test_targets_are_where_the_rendered_map_has_them(small_world, renderer):
    for target in small_world["survey"][1].targets:
        eye = target.position + np.array([0.0, 0.0, 90.0])
        view = renderer.render(Pose(NADIR, eye), CAMERA, wait=True)
        depth = view.depth[118:122, 158:162]
        assert abs(float(np.median(depth)) - 90.0) < 0.15, target.name


def test_nothing_stands_below_the_ground_and_no_hole_is_seen(small_world, renderer):
    _, info = small_world["survey"]
    view = renderer.render(Pose(NADIR, np.array([0, 0, 120.0])), CAMERA, wait=True)
    assert (view.depth > 0).all()
    v, u = np.mgrid[0:240, 0:320]
    rays = CAMERA.rays(np.stack([u + 0.5, v + 0.5], -1))
    points = Pose(NADIR, np.array([0, 0, 120.0])).apply(rays * view.depth[..., None])
    above = points[..., 2] - info.ground_height(points[..., 0], points[..., 1])
    assert above.min() > -0.1
    assert above.max() > 4.0  # buildings and trees
    assert np.median(above) < 3.0


def test_a_car_drives_on_the_street(small_world, renderer):
    _, info = small_world["survey"]
    road = info.roads[0]
    place = road[len(road) // 2]
    car = car_mesh((220, 30, 30)).placed(Pose(np.eye(3), place))
    pose = Pose(NADIR, place + np.array([0.0, 0.0, 40.0]))
    plain = renderer.render(pose, CAMERA, wait=True)
    drawn = renderer.render(pose, CAMERA, [car], wait=True)
    nearer = plain.depth - drawn.depth
    pixels = nearer > 0.2
    assert 150 < pixels.sum() < 700  # 4.5 x 1.84 m at 0.14 m per pixel
    assert 0.8 < nearer[pixels].max() < 3.0


# --- appearance ---------------------------------------------------------------------------------


@pytest.fixture
def view() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    rgb = rng.integers(40, 200, (96, 128, 3), dtype=np.uint8)
    depth = np.tile(np.linspace(400, 60, 96, dtype=np.float32)[:, None], (1, 128))
    depth[:8] = 0.0
    return rgb, depth


def test_the_default_appearance_changes_nothing(view: tuple[np.ndarray, np.ndarray]) -> None:
    rgb, depth = view
    np.testing.assert_array_equal(
        apply_appearance(rgb, depth, Appearance(), np.random.default_rng(0)), rgb
    )


@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_is_deterministic_and_visible(condition, view):
    rgb, depth = view

    def draw() -> np.ndarray:
        rng = np.random.default_rng(5)
        return apply_appearance(rgb, depth, sample_appearance(rng, condition), rng)

    image = draw()
    assert image.shape == rgb.shape
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, draw())
    assert np.abs(image.astype(int) - rgb).mean() > 3
