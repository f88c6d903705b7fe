"""A picture through a longer lens than the deployment's, laid on the map part by part."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from companion.calibrate.pictures import PictureReader
from localizer.features.detail import DetailExtractor
from localizer.features.gradient import GradientExtractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.types import Frame, RenderedView

CAMERA = Camera.from_fov(320, 240, 65.0)


class Plane:
    """A renderer of one textured plane 100 m below, whatever it is asked."""

    def __init__(self, depth_m: float = 100.0) -> None:
        self.depth_m = depth_m
        noise = np.random.default_rng(3).normal(size=(240, 320, 3)).astype(np.float32)
        smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
        self.rgb = np.clip(128 + 400 * smooth, 0, 255).astype(np.uint8)

    def render(self, pose, camera, extra=(), *, wait=False):
        return RenderedView(self.rgb, np.full((240, 320), self.depth_m, np.float32), pose, camera)


@pytest.mark.parametrize("longer", [1.0, 1.008])
def test_each_part_is_found_where_the_picture_has_it(longer):
    plane = Plane()
    middle = np.array([CAMERA.cx - 0.5, CAMERA.cy - 0.5])
    scale = np.hstack([longer * np.eye(2), ((1 - longer) * middle)[:, None]])
    image = cv2.warpAffine(plane.rgb, scale, (320, 240), flags=cv2.INTER_LINEAR)
    reader = PictureReader(plane, DetailExtractor(GradientExtractor()), CAMERA, 320)
    pose = Pose.identity()
    parts = reader.read(Frame(image, 0, CAMERA, 0), pose, None)
    assert parts is not None
    assert len(parts.points) > 40
    expected, _ = CAMERA.project(parts.points)
    expected = (expected - (CAMERA.cx, CAMERA.cy)) * longer + (CAMERA.cx, CAMERA.cy)
    off = np.hypot(*(parts.pixels - expected).T)
    assert np.median(off) < 0.1
    assert np.percentile(off, 90) < 0.3


def test_a_view_beside_the_map_gives_nothing():
    plane = Plane(depth_m=0.0)
    reader = PictureReader(plane, DetailExtractor(GradientExtractor()), CAMERA, 320)
    assert reader.read(Frame(plane.rgb, 0, CAMERA, 0), Pose.identity(), None) is None
