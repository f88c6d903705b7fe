from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from localizer.errors import CameraError
from localizer.geometry.camera import Camera

BROWN = (-0.21, 0.07, 0.0011, -0.0008, -0.012)
RATIONAL = (2.5, 1.1, 0.0002, -0.0003, 0.05, 2.8, 1.8, 0.25)
PRISM = (*RATIONAL, 0.004, -0.001, 0.003, 0.002)
TILTED = (*PRISM, 0.03, -0.02)
FISHEYE = (-0.012, 0.003, -0.002, 0.0004)
LENSES = [
    ("opencv", (0.0,) * 5), ("opencv", BROWN), ("opencv", RATIONAL), ("opencv", PRISM),
    ("opencv", TILTED), ("fisheye", FISHEYE),
]  # fmt: skip


@pytest.fixture
def camera():
    return Camera(640, 480, 610.0, 605.0, 331.0, 236.0)


@pytest.fixture
def distorted(camera):
    return replace(camera, distortion=BROWN)


def opencv_project(points, camera):
    """OpenCV's projection; its pixel centres are at integers, ours half a pixel further."""
    K = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    module = cv2.fisheye if camera.distortion_model == "fisheye" else cv2
    pixels, _ = module.projectPoints(
        points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.array(camera.distortion)
    )
    return pixels.reshape(-1, 2) + 0.5


def cloud(n=200):
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)), np.ones(n)]) * rng.uniform(
        5, 400, (n, 1)
    )


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_projection_is_opencvs_plus_half_a_pixel(camera, model, distortion):
    camera = replace(camera, distortion=distortion, distortion_model=model)
    pixels, _ = camera.project(cloud())
    np.testing.assert_allclose(pixels, opencv_project(cloud(), camera), atol=1e-8)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_rays_invert_the_projection(camera, model, distortion):
    camera = replace(camera, distortion=distortion, distortion_model=model)
    rng = np.random.default_rng(1)
    pixels = rng.uniform([0, 0], [640, 480], (300, 2))
    again, inside = camera.project(camera.rays(pixels) * 37.0)
    assert inside.mean() > 0.97  # on the very border rounding may put one out
    np.testing.assert_allclose(again, pixels, atol=1e-6)


def test_points_behind_are_not_in_view(camera):
    pixels, inside = camera.project([[0.0, 0.0, -5.0], [0.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    np.testing.assert_array_equal(inside, [False, False, True])
    assert np.isnan(pixels[:2]).all()


def test_resizing_keeps_every_ray(camera):
    small = camera.resized(320, 120)
    pixels = np.array([[0.0, 0.0], [100.0, 300.0], [640.0, 480.0]])
    np.testing.assert_allclose(
        small.rays(pixels * [320 / 640, 120 / 480]), camera.rays(pixels), atol=1e-12
    )
    assert small.resized(640, 480) == camera


def test_resizing_agrees_with_cv2_resize(camera):
    """A dot drawn at a known ray lies at the resized camera's pixel in the resized image."""
    image = np.zeros((480, 640), np.float32)
    image[200:204, 300:304] = 1.0
    small = cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA)
    rows, columns = np.nonzero(small)
    centre = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
    expected, _ = camera.resized(160, 120).project(camera.rays([302.0, 202.0]))
    np.testing.assert_allclose(centre, expected, atol=1e-9)


@pytest.mark.parametrize(("model", "distortion"), LENSES[1:])
def test_undistortion_maps_put_every_ray_where_the_pinhole_sees_it(camera, model, distortion):
    """A smooth picture of the ray direction: after remapping each pixel shows its own ray."""
    distorted = replace(camera, distortion=distortion, distortion_model=model)
    target = distorted.without_distortion().resized(320, 240)
    v, u = np.mgrid[0:480, 0:640] + 0.5
    seen = distorted.rays(np.stack([u, v], axis=-1))[..., :2].astype(np.float32)
    map_x, map_y = distorted.undistortion_maps(target)
    remapped = cv2.remap(seen, map_x, map_y, cv2.INTER_LINEAR)
    v, u = np.mgrid[0:240, 0:320] + 0.5
    expected = target.rays(np.stack([u, v], axis=-1))[..., :2]
    inner = np.s_[12:-12, 12:-12]
    # cv2's fixed-point maps resolve 1/32 pixel.
    np.testing.assert_allclose(remapped[inner], expected[inner], atol=1.0 / 32 / 600)


def test_what_a_polynomial_folds_back_into_the_picture_is_not_seen(camera):
    """Brown's model brings a ray 65 degrees off the axis back to 30: no lens does."""
    folding = replace(camera, distortion=(-0.2, 0.0, 0.0, 0.0, 0.0))
    pixels, inside = folding.project([[2.0, 0.0, 1.0], [0.4, 0.0, 1.0]])
    assert 0 < pixels[0, 0] < camera.width
    np.testing.assert_array_equal(inside, [False, True])
    wide = Camera(640, 480, 130.0, 130.0, 320.0, 240.0)
    maps = folding.undistortion_maps(wide)
    white = np.full((480, 640), 255, np.uint8)
    shown = cv2.remap(white, maps[0], maps[1], cv2.INTER_LINEAR)
    columns = np.flatnonzero(shown[240])
    reach = (folding.rays([[0.0, 240.0], [640.0, 240.0]]) * 130)[:, 0] + 320
    assert columns[0] + 0.5 == pytest.approx(reach[0], abs=20)
    assert columns[-1] + 0.5 == pytest.approx(reach[1], abs=20)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_dictionary_and_json_round_trip(camera, model, distortion, tmp_path):
    distorted = replace(camera, distortion=distortion, distortion_model=model)
    assert Camera.from_dict(distorted.to_dict()) == distorted
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(distorted.to_dict()))
    assert Camera.from_json(path) == distorted


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0.0}, "focal"),
        ({"fy": -3.0}, "focal"),
        ({"cx": float("nan")}, "finite"),
        ({"width": 2}, "8x8"),
        ({"distortion": (0.0, 0.0)}, "k1 k2 p1 p2 k3"),
    ],
)
def test_impossible_cameras(camera, change, message):
    with pytest.raises(CameraError, match=message):
        replace(camera, **change)
