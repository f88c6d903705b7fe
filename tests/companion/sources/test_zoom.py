"""A camera that zooms: the focal length of its report, and no fix where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from companion.sources.zoom import ZoomedFrames, ZoomTable
from localizer.geometry.camera import Camera
from localizer.types import Frame

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
TABLE = ZoomTable(points=((0.0, 1.0), (50.0, 2.0), (100.0, 4.5)))
SECOND = 10**9


def frame(time_ns: int) -> Frame:
    return Frame(np.zeros((48, 64, 3), np.uint8), time_ns, CAMERA, 0)


class Zoom:
    """A camera that says a level, or none; what was told."""

    def __init__(self, level: float | None) -> None:
        self.level, self.told = level, list[str]()
        self.frames = ZoomedFrames(TABLE, lambda _time_ns, _hold_s: self.level, self.told.append)


def test_between_its_points_the_table_rises_and_beyond_them_it_says_nothing() -> None:
    factors = [TABLE.factor(level) for level in np.linspace(0.0, 100.0, 41)]
    assert factors[0] == 1.0
    assert factors[-1] == pytest.approx(4.5)
    assert np.diff([f for f in factors if f is not None]).min() > 0.0
    assert TABLE.factor(25.0) == pytest.approx(np.sqrt(2.0))
    short = ZoomTable(points=((10.0, 1.0), (60.0, 2.0)))
    assert short.factor(9.0) is None
    assert short.factor(61.0) is None


@pytest.mark.parametrize(
    "points",
    [
        ((0.0, 1.0),),
        ((0.0, 2.0), (50.0, 1.0)),
        ((50.0, 1.0), (50.0, 2.0)),
        ((0.0, 0.0), (50.0, 1.0)),
        ((0.0, 1.0), (120.0, 2.0)),
        ((0.0, 1.0), (50.0, float("nan"))),
    ],
)
def test_a_table_that_no_lens_has_is_refused(points: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ValidationError):
        ZoomTable(points=points)


def test_a_frame_has_the_camera_of_its_zoom() -> None:
    seen = Zoom(50.0).frames(frame(SECOND))
    assert seen is not None
    assert (seen.camera.fx, seen.camera.fy) == (100.0, 100.0)
    assert (seen.camera.cx, seen.camera.width) == (32.0, 64)


def test_a_report_that_trembles_is_no_other_camera() -> None:
    """Each other camera costs new undistortion maps."""
    zoom = Zoom(50.0)
    first = zoom.frames(frame(SECOND))
    zoom.level = 50.03  # 0.04 % of focal length
    second = zoom.frames(frame(2 * SECOND))
    zoom.level = 50.2
    third = zoom.frames(frame(3 * SECOND))
    assert first is not None
    assert second is not None
    assert third is not None
    assert first.camera == second.camera != third.camera


@pytest.mark.parametrize("level", [None, 101.0])
def test_a_zoom_that_is_not_known_gives_no_frame_and_is_told(level: float | None) -> None:
    """Once in ten seconds, and again when it comes again."""
    zoom = Zoom(level)
    for second in range(25):
        zoom.frames.zoom_filter(pytest.fail)(frame(second * SECOND))
    assert len(zoom.told) == 3
    assert zoom.frames.unknown == 25
    zoom.level = 0.0
    taken: list[Frame] = []
    zoom.frames.zoom_filter(taken.append)(frame(26 * SECOND))
    assert [f.exposure_time_ns for f in taken] == [26 * SECOND]
    zoom.level = level
    assert zoom.frames(frame(27 * SECOND)) is None
    assert len(zoom.told) == 4
