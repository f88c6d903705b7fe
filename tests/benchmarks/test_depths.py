"""Depths of two views of one surface: agreement where both see it, hidden where they do not."""

import numpy as np
import pytest

from benchmarks.depths import CAMERA, agreement, carried
from localizer.geometry.pose import Pose, so3_exp
from localizer.types import RenderedView

DOWN = np.diag([1.0, -1.0, -1.0])


class Ground:
    """Draws a plane at a height, exactly; with a wall's worth of error from some views."""

    name = "exact"

    def __init__(self, error: float = 0.0) -> None:
        self.error, self.count = error, 0

    def render(self, world_from_camera, camera, extra=(), *, wait=False):
        self.count += 1
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        rays = camera.rays(np.stack([u, v], axis=-1)) @ world_from_camera.rotation.T
        with np.errstate(divide="ignore"):
            depth = -world_from_camera.translation[2] / rays[..., 2]
        depth = np.where((rays[..., 2] < 0) & (depth < 1e4), depth, 0.0)
        depth *= 1.0 + self.error * (self.count % 3 == 0)  # of the second view of each pair
        rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
        return RenderedView(rgb, depth.astype(np.float32), world_from_camera, camera)


def test_exact_views_of_a_plane_agree_to_float32():
    found = agreement(Ground(), 1000.0, 200.0, 2)
    assert len(found.errors) > 100_000
    assert found.hidden == 0.0
    assert np.percentile(found.errors, 99) < 1e-6


def test_views_that_err_by_a_part_in_a_hundred_do_not():
    found = agreement(Ground(error=0.01), 1000.0, 200.0, 2)
    assert np.median(found.errors) == pytest.approx(0.01, abs=2e-3)


def test_what_a_roof_hides_is_no_disagreement():
    ground = Ground()
    one = ground.render(Pose(DOWN, np.array([0.0, 0.0, 100.0])), CAMERA)
    tilted = Pose(so3_exp([0.2, 0, 0]) @ DOWN, np.array([0.0, 10.0, 100.0]))
    other = ground.render(tilted, CAMERA)
    other.depth[100:300, 200:400] *= 0.8  # a roof before the ground
    z, seen = carried(one, other)
    relative = (z - seen) / z
    assert (relative > 0.02).mean() == pytest.approx((relative > 0.19).mean(), abs=0.01)
    assert 0.05 < (relative > 0.19).mean() < 0.3
    assert np.percentile(np.abs(relative[relative < 0.02]), 99) < 1e-4
