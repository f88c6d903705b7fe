"""Where a keyframe's anchors come from."""

from dataclasses import replace

import numpy as np
import pytest

from localizer.device_array import DeviceArray
from localizer.errors import DeviceArrayError
from localizer.odometry.ground import FlatGround, ground_points, height_above_ground
from localizer.odometry.keyframe import DepthSource, keyframe_anchors
from localizer.registration.sampling import sample_features
from tests.localizer.odometry.conftest import CAMERA
from tests.localizer.registration.conftest import camera_pose

POSE = camera_pose(np.array([5.0, -3.0, 80.0]), 60.0, 30.0)


class Slope:
    """Rises 0.1 m per metre to the east."""

    def height(self, east, north):
        return 0.1 * east


def test_map_points_keep_their_places_and_get_the_pictures_features(hills):
    features, surface = hills.frame(3).features, hills.surface(3)
    anchors, source = keyframe_anchors(features, CAMERA, hills.pose(3), surface, None, 5000)
    assert source is DepthSource.MAP
    assert len(anchors.points_world) > 0.8 * len(surface)
    assert {tuple(p) for p in anchors.points_world} <= {tuple(p) for p in surface}
    pixels, inside = CAMERA.project(hills.pose(3).inverse.apply(anchors.points_world))
    assert inside.all()
    np.testing.assert_allclose(pixels, anchors.pixels, atol=1e-4)
    level = features.levels[-1]
    uv = anchors.pixels.astype(np.float64) / level.stride - 0.5
    np.testing.assert_allclose(
        anchors.features[-1], sample_features(level.features, uv[:, 0], uv[:, 1]), atol=1e-5
    )


def test_the_ground_fills_what_the_map_leaves(hills):
    """The map ends in the middle of the picture: each half gets its own depth."""
    surface, pose = hills.surface(3), hills.pose(3)
    pixels, _ = CAMERA.project(pose.inverse.apply(surface))
    left = surface[pixels[:, 0] < CAMERA.width / 2]
    ground = FlatGround(-50.0)  # far below the map's surfaces, to tell them apart
    anchors, source = keyframe_anchors(hills.frame(3).features, CAMERA, pose, left, ground, 600)
    by_map = anchors.points_world[:, 2] > -20
    assert (anchors.pixels[by_map, 0] < CAMERA.width / 2 + 2).all()
    right = anchors.pixels[:, 0] > CAMERA.width / 2 + 12
    assert right.sum() > 150
    assert not by_map[right].any()
    assert source is DepthSource.MAP
    few, source = keyframe_anchors(hills.frame(3).features, CAMERA, pose, left[::10], ground, 600)
    assert source is DepthSource.GROUND
    assert len(few.points_world) > 300


@pytest.mark.parametrize("ground", [FlatGround(4.0), Slope()])
def test_rays_meet_the_ground_where_it_is(ground):
    pixels = np.array([[10.0, 20.0], [80.0, 60.0], [150.0, 110.0]])
    points, met = ground_points(ground, POSE, CAMERA, pixels)
    assert met.all()
    np.testing.assert_allclose(points[:, 2], ground.height(*points.T[:2]), atol=0.01)
    np.testing.assert_allclose(CAMERA.project(POSE.inverse.apply(points))[0], pixels, atol=1e-6)


def test_features_on_the_gpu_are_refused(hills):
    level = hills.frame(0).features.levels[0]
    on_device = replace(level, features=DeviceArray(64, level.features.shape, np.dtype("f4")))
    features = replace(hills.frame(0).features, levels=(on_device,))
    with pytest.raises(DeviceArrayError, match="extracted to the host"):
        keyframe_anchors(features, CAMERA, POSE, None, FlatGround(0.0), 500)


def test_the_ground_is_below_the_roofs():
    rng = np.random.default_rng(0)
    heights = np.r_[rng.normal(12.0, 0.3, 600), rng.uniform(16.0, 30.0, 400)]
    points = np.column_stack([rng.uniform(0, 100, (1000, 2)), heights])
    assert FlatGround.under(points).height_m == pytest.approx(12.0, abs=0.4)


def test_an_uncertain_place_above_a_slope_is_at_an_uncertain_height_above_the_ground():
    """10 m of sigma across 20 % of slope are 2 m of height; along the slope's contours none."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-50, 50, (500, 2)), np.zeros(500)])
    points[:, 2] = 0.2 * points[:, 0] + rng.normal(0, 0.5, 500)
    place = np.array([0.0, 0.0, 80.0])
    for variance, expected in (((100.0, 0.0, 1.0), 5**0.5), ((0.0, 100.0, 1.0), 1.0)):
        above, sigma = height_above_ground(points, np.diag(variance), place)
        assert above == pytest.approx(80.0, abs=1.0)
        assert sigma == pytest.approx(expected, rel=0.05)
