"""Views of one ground laid together: where each shows it, and what is none of it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import so3_exp
from localizer.relocalization.patch import with_heading
from localizer.relocalization.strip import GroundView, lay_together
from localizer.render.topview import DOWN

CAMERA = Camera.from_fov(240, 180, 60.0)
HEIGHT, SIDE_M, PX_M = 100.0, 800, 0.5


def ground(seed):
    """(n, n, 3) of a square about the origin, north up, a pixel every `PX_M`."""
    n = round(SIDE_M / PX_M)
    grey = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(n, n)), (0, 0), 3)
    grey = np.clip(128 + 50 * grey / grey.std(), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def view_of(picture, place, height=HEIGHT, tilt_deg=12.0, heading_deg=30.0):
    rotation = with_heading(so3_exp((np.radians(tilt_deg), 0, 0)) @ DOWN, np.radians(heading_deg))
    u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    rays = CAMERA.rays(np.stack([u, v], axis=-1).reshape(-1, 2)) @ rotation.T
    at = np.asarray(place) + height * rays[:, :2] / -rays[:, 2:]
    x = ((at[:, 0] + SIDE_M / 2) / PX_M - 0.5).reshape(u.shape).astype(np.float32)
    y = ((SIDE_M / 2 - at[:, 1]) / PX_M - 0.5).reshape(u.shape).astype(np.float32)
    return GroundView(cv2.remap(picture, x, y, cv2.INTER_LINEAR), CAMERA, rotation, height)


def shown(strip, picture):
    """Correlation of the strip with the ground as seen from the first view's camera (origin)."""
    n = strip.image.shape[0]
    u, v = np.meshgrid(np.arange(n) + 0.5, np.arange(n) + 0.5)
    rays = strip.camera.rays(np.stack([u, v], axis=-1).reshape(-1, 2)) @ DOWN.T
    at = HEIGHT * rays[:, :2] / -rays[:, 2:]
    x = ((at[:, 0] + SIDE_M / 2) / PX_M - 0.5).reshape(n, n).astype(np.float32)
    y = ((SIDE_M / 2 - at[:, 1]) / PX_M - 0.5).reshape(n, n).astype(np.float32)
    true, seen = cv2.remap(picture, x, y, cv2.INTER_LINEAR)[..., 0], strip.image[..., 3] == 255
    return np.corrcoef(true[seen], strip.image[..., 0][seen])[0, 1], seen


def flown(picture, count=6):
    """Newest first: along a bend, climbing, swinging."""
    places = [(-11.0 * k, -5.0 * k + 0.8 * k**2) for k in range(count)]
    return [
        view_of(picture, place, HEIGHT - 2.0 * k, 12.0 - 3 * (k % 2), 30.0 + 6 * k)
        for k, place in enumerate(places)
    ]


def test_views_are_laid_where_they_show_the_ground():
    picture = ground(1)
    views = flown(picture)
    strip = lay_together(views, 400.0, 0.5)
    assert strip is not None
    alike, seen = shown(strip, picture)
    assert alike > 0.9
    two = lay_together(views[:2], 400.0, 0.5)
    assert two is not None
    assert seen.sum() > 1.3 * shown(two, picture)[1].sum()
    assert strip.image.shape[0] * 0.5 == pytest.approx(strip.seen.side_m * HEIGHT, abs=0.5)


def test_a_strip_ends_where_views_have_nothing_in_common_and_at_its_largest_side():
    picture, elsewhere = ground(1), ground(2)
    views = flown(picture)
    cut = lay_together([*views[:3], view_of(elsewhere, (-33.0, 0.0)), *views[4:]], 400.0, 0.5)
    three = lay_together(views[:3], 400.0, 0.5)
    assert cut is not None
    assert three is not None
    np.testing.assert_array_equal(cut.image, three.image)
    one = lay_together(views[:1], 400.0, 0.5)
    assert one is not None
    for other in (elsewhere, np.zeros_like(picture)):
        alone = lay_together([views[0], view_of(other, (-11.0, 0.0))], 400.0, 0.5)
        assert alone is not None
        np.testing.assert_array_equal(alone.image, one.image)
    largest = three.seen.side_m * HEIGHT + 1.0
    limited = lay_together(views, largest, 0.5)
    assert limited is not None
    assert limited.seen.side_m * HEIGHT <= largest
    np.testing.assert_array_equal(limited.image, three.image)


def test_there_is_no_strip_of_a_few_pixels_and_none_reaches_to_views_of_no_ground():
    picture = ground(1)
    views = flown(picture, 3)
    assert lay_together([replace(v, height_m=1.0) for v in views], 400.0, 0.5) is None
    for unfit in (replace(views[1], height_m=-8.0), replace(views[1], rotation=np.eye(3))):
        alone, one = (lay_together(v, 400.0, 0.5) for v in ([views[0], unfit], views[:1]))
        assert alone is not None
        assert one is not None
        np.testing.assert_array_equal(alone.image, one.image)
