"""A frame of another focal length: the working picture shows the world where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.tracking.pipeline import Undistorter, working_camera
from localizer.types import Frame

CAMERA = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)
DIRECTION = np.array([0.12, -0.08, 1.0])


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.05, 1.6])
@pytest.mark.parametrize("bent", [0.0, -0.05])
def test_a_zoomed_frame_shows_a_light_in_its_true_direction(factor: float, bent: float) -> None:
    """A pinhole's pictures were only resized: the light of a 5 % longer lens was 1.8 px off."""
    lens = replace(CAMERA, distortion=(bent, 0.0, 0.0, 0.0, 0.0))
    source = replace(lens, fx=600.0 * factor, fy=600.0 * factor)
    target = working_camera(lens, 320)
    (u, v), _ = source.project(DIRECTION)
    rows, columns = np.mgrid[:480, :640] + 0.5
    light = 255.0 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 6.0**2))
    image = np.repeat(light[..., None], 3, axis=2).astype(np.uint8)
    seen = Undistorter(source, target)(Frame(image, 0, source, 0))[..., 0].astype(float)
    rows, columns = np.mgrid[: target.height, : target.width] + 0.5
    found = np.array([(seen * columns).sum(), (seen * rows).sum()]) / seen.sum()
    wanted, _ = target.project(DIRECTION)
    assert np.abs(found - wanted).max() < 0.15


def test_a_lens_is_another_from_a_thousandth_on() -> None:
    """Below it new undistortion maps would cost more than they mend."""
    for share, alike in ((0.0, True), (0.0005, True), (0.002, False)):
        f = 600.0 * (1.0 + share)
        assert CAMERA.is_like(replace(CAMERA, fx=f, fy=f)) == alike
    assert not CAMERA.is_like(replace(CAMERA, cx=321.0))
    assert not CAMERA.is_like(CAMERA.resized(320, 240))
