"""A lens that zooms: its picture is that of a longer camera, its level what the table expects."""

from __future__ import annotations

import numpy as np
import pytest

from companion.sources.zoom import ZoomTable, with_focal_factor
from localizer.geometry.camera import Camera
from sitl.camera.zoom import Zooming, ZoomLens, level_of
from sitl.suite.loop.case import load_loop_cases

CAMERA = Camera(160, 120, 150.0, 150.0, 78.0, 61.0, (-0.1, 0.02, 0.0, 0.0, 0.0))


def dot_at(image: np.ndarray) -> tuple[float, float]:
    """Centre of what is bright, with pixel centres at (u + 0.5, v + 0.5)."""
    weight = image[..., 0].astype(float)
    rows, columns = np.indices(weight.shape) + 0.5
    return float((columns * weight).sum() / weight.sum()), float(
        (rows * weight).sum() / weight.sum()
    )


@pytest.mark.parametrize("factor", [1.0, 1.2, 1.4])
def test_what_it_shows_lies_where_the_longer_camera_has_it(factor: float) -> None:
    point = np.array([0.15, -0.1, 1.0])
    image = np.zeros((120, 160, 3), np.uint8)
    pixel, _ = CAMERA.project(point)
    image[int(pixel[1]), int(pixel[0])] = 255
    ray = CAMERA.rays([int(pixel[0]) + 0.5, int(pixel[1]) + 0.5])
    lens = ZoomLens(CAMERA)
    lens.set(Zooming(1.0, factor, 0, 10))
    wanted, _ = with_focal_factor(CAMERA, factor).project(ray)
    assert dot_at(lens.apply(image, 20)) == pytest.approx(tuple(wanted), abs=0.3)


def test_it_moves_between_its_begin_and_its_end() -> None:
    zooming = Zooming(1.0, 1.4, 100, 200)
    assert [zooming.at(t) for t in (0, 150, 900)] == pytest.approx([1.0, 1.2, 1.4])
    assert level_of(zooming.at(900)) == pytest.approx(40.0)


def test_the_scenarios_table_is_near_the_lens_and_not_the_same() -> None:
    (case,) = load_loop_cases(["normal-zooms-told"])
    table = ZoomTable(points=case.zoom_points)
    off = [abs((table.factor(level_of(f)) or 0.0) / f - 1.0) for f in np.linspace(1.0, 2.0, 41)]
    assert 0.003 < max(off) < 0.007
    assert case.is_normal
    (unreported,) = load_loop_cases(["zooms-untold"])
    assert not unreported.is_normal
    assert unreported.needs_shadow_check
