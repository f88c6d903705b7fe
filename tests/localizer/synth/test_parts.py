"""Light, packing, terrain and props, each by itself."""

import numpy as np

from localizer.synth.config import SURVEY, VisitLook
from localizer.synth.paint.lighting import DSM_GSD_M, make_light, raise_surface
from localizer.synth.tiles.charts import ChartedMesh, pack
from localizer.synth.tiles.props import CAR_HEIGHT_M, CAR_LENGTH_M, car_mesh


def flat_light(look: VisitLook):
    """Light about a block of 4 x 4 m and 10 m height in the middle of 60 x 60 m."""
    ground = np.zeros((120, 120), np.float32)
    dsm = ground.copy()
    quad = np.array([[-2, -2, 10], [2, -2, 10], [2, 2, 10], [-2, 2, 10]], float)
    raise_surface(dsm, np.stack([quad[[0, 1, 2]], quad[[0, 2, 3]]]), -30.0, 30.0, DSM_GSD_M)
    return dsm, make_light(dsm, ground, -30.0, 30.0, (0, 0, 120, 120), look)


def sample(grid, east, north):
    return grid[int((30 - north) / DSM_GSD_M), int((east + 30) / DSM_GSD_M)]


def test_a_block_raises_the_surface_model_where_it_stands():
    dsm, _ = flat_light(SURVEY)
    assert sample(dsm, 0, 0) == 10.0
    assert sample(dsm, 3, 0) == 0.0
    assert abs((dsm > 0).sum() * DSM_GSD_M**2 - 16.0) < 3.0


def test_shadow_falls_away_from_the_sun_and_is_as_long_as_its_height_says():
    look = VisitLook(sun_azimuth_deg=90.0, sun_elevation_deg=45.0)  # sun in the east
    _, light = flat_light(look)
    assert sample(light.ceiling, -6, 0) > 0  # to the west: shadow
    assert sample(light.ceiling, 6, 0) <= 0
    assert sample(light.ceiling, 0, 6) <= 0
    shadow = light.ceiling[60] > 0.25
    west_end = -30 + np.flatnonzero(shadow)[0] * DSM_GSD_M
    assert abs(west_end - (-2 - 10.0)) < 1.0  # 10 m at 45 degrees, from the far edge: -12 m


def test_packed_charts_come_back_whole():
    rng = np.random.default_rng(0)
    charts = tuple(
        rng.integers(0, 255, (h, w, 3), np.uint8) for h, w in rng.integers(2, 60, (40, 2))
    )
    ground = rng.integers(0, 255, (80, 80, 3), np.uint8)
    atlas = pack(ground, charts, gutter=8, pad=3)
    u, v = atlas.ground
    np.testing.assert_array_equal(atlas.image[v : v + 80, u : u + 80], ground)
    for chart, (x, y) in zip(charts, atlas.offsets.astype(int), strict=True):
        h, w = chart.shape[:2]
        np.testing.assert_array_equal(atlas.image[y : y + h, x : x + w], chart)
        np.testing.assert_array_equal(atlas.image[y - 3, x : x + w], chart[0])


def test_a_level_keeps_only_its_faces_and_their_charts():
    mesh = ChartedMesh(
        np.arange(18.0).reshape(6, 3),
        np.array([0, 0, 0, 1, 1, 1]),
        np.zeros((6, 2)),
        np.array([[0, 1, 2], [3, 4, 5]]),
        np.array([1, 2], np.uint8),
        (np.zeros((4, 4, 3), np.uint8), np.ones((6, 8, 3), np.uint8)),
    )
    coarse = mesh.at_level(2).halved()
    assert coarse.faces.tolist() == [[0, 1, 2]]
    np.testing.assert_array_equal(coarse.positions, mesh.positions[3:])
    assert [c.shape for c in coarse.charts] == [(3, 4, 3)]
    both = ChartedMesh.merged([mesh, mesh])
    assert both.faces.max() == 11
    assert both.chart.max() == 3


def test_a_car_has_the_size_of_a_car_and_closed_outer_faces():
    car = car_mesh(seed=3)
    low, high = car.positions.min(0), car.positions.max(0)
    np.testing.assert_allclose(high - low, [CAR_LENGTH_M, 1.84, CAR_HEIGHT_M - 0.22], atol=1e-3)
    p = car.positions.astype(float)
    a, b, c = (p[car.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (((a + b + c) / 3 - [0, 0, 0.75]) * normal).sum(axis=1).min() > -1e-6
    assert car.uvs.min() >= 0
    assert car.uvs.max() <= 1
    red = car_mesh((200, 20, 20)).mips[0].reshape(-1, 3).mean(axis=0)
    assert red[0] > red[1] + 20
