"""Holes of the map in a rendered view: what is painted over, and with what."""

import cv2
import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.render.base import SKY
from localizer.render.holes import fill_holes
from localizer.types import RenderedView

CAMERA = Camera.from_fov(64, 48, 60)
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # x east, y south
LEVEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # looks north, the horizon in the middle


def _view(rgb, known, rotation=DOWN):
    rgb = np.where(known[..., None], rgb, np.array(SKY)).astype(np.uint8)
    pose = Pose(rotation, np.array([0.0, 0.0, 100.0]))
    return RenderedView(rgb, known.astype(np.float32) * 100, pose, CAMERA)


def _disc(u, v, radius):
    y, x = np.mgrid[0:48, 0:64]
    return (x - u) ** 2 + (y - v) ** 2 > radius**2


def _ramp():
    y, x = np.mgrid[0:48, 0:64].astype(float)
    return np.stack([40 + 2 * x, 30 + 3 * y, 200 - x - y], -1).round().astype(np.uint8)


@pytest.mark.parametrize("shown", [True, False])
def test_a_whole_view_and_one_of_nothing_are_left_alone(shown):
    view = _view(_ramp(), np.full((48, 64), shown))
    assert fill_holes(view) is view.rgb


@pytest.mark.parametrize("known", [_disc(30, 20, 9), _disc(0, 0, 30), _disc(63, 47, 1)])
def test_a_hole_takes_the_colour_around_it_and_nothing_else_changes(known):
    plain = np.full((48, 64, 3), (90, 120, 60), np.uint8)
    assert (fill_holes(_view(plain, known)) == plain).all()
    view = _view(_ramp(), known)
    filled = fill_holes(view)
    assert (filled[known] == view.rgb[known]).all()


def test_a_hole_leaves_no_edge():
    known = _disc(30, 20, 9)
    view = _view(_ramp(), known)
    border = cv2.dilate((~known).astype(np.uint8), np.ones((3, 3))) > 0

    def steepest(image):
        return np.abs(cv2.Laplacian(image.astype(np.float32), cv2.CV_32F))[border].max()

    assert steepest(fill_holes(view)) < 0.2 * steepest(view.rgb)
    assert np.abs(fill_holes(view).astype(int) - _ramp())[~known].max() < 40


def test_the_sky_stays_and_the_ground_below_it_does_not():
    known = np.ones((48, 64), bool)
    known[:28] = False  # the map ends 4 rows below the horizon
    filled = fill_holes(_view(_ramp(), known, LEVEL))
    assert (filled[:24] == SKY).all()
    assert (np.abs(filled[24:28].astype(int) - _ramp()[28]) < 40).all()
