"""Camera files as programs write them: read as the lens that they say, or refused by its name."""

from __future__ import annotations

import json

import pytest

from localizer.errors import CameraError
from localizer.geometry.camera import Camera
from tests.localizer.geometry.test_camera import BROWN, FISHEYE, PRISM, RATIONAL

MILD = (0.18, 0.04, 0.0002, -0.0003, 0.002, 0.30, 0.09, 0.01)
NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
PINHOLE = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
MATRIX = [500.0, 0, 319.5, 0, 500.0, 239.5, 0, 0, 1]  # OpenCV counts from the first pixel's centre
KALIBR = {"camera_model": "pinhole", "intrinsics": [500.0, 500.0, 319.5, 239.5],
          "resolution": [640, 480], "rostopic": "/cam0/image_raw"}  # fmt: skip


def keys(values, names=NAMES):
    return dict(zip(names, values, strict=False))


@pytest.mark.parametrize(
    ("data", "model", "distortion"),
    [
        (PINHOLE, "opencv", (0.0,) * 5),
        (PINHOLE | keys(BROWN), "opencv", BROWN),
        (PINHOLE | {"distortion": [0.1, 0.02]}, "opencv", (0.1, 0.02, 0, 0, 0)),
        (PINHOLE | {"distortion": [*BROWN, 0, 0, 0]}, "opencv", BROWN),
        (PINHOLE | {"distortion": RATIONAL}, "opencv", RATIONAL),
        (PINHOLE | {"distortion": MILD}, "opencv", MILD),
        (PINHOLE | keys(RATIONAL), "opencv", RATIONAL),
        (PINHOLE | {"distortion": keys(RATIONAL)}, "opencv", RATIONAL),
        (PINHOLE | {"model": "FULL_OPENCV", "distortion": RATIONAL}, "opencv", RATIONAL),
        (PINHOLE | {"distortion": PRISM, "distortion_model": "thin_prism"}, "opencv", PRISM),
        (PINHOLE | keys((*PRISM, 0.03, -0.02)), "opencv", (*PRISM, 0.03, -0.02)),
        (PINHOLE | {"dist_coeffs": BROWN}, "opencv", BROWN),
        (PINHOLE | {"distortion_model": "equidistant", "D": FISHEYE}, "fisheye", FISHEYE),
        (PINHOLE | {"distortion": FISHEYE[:2], "model": "RADIAL_FISHEYE"}, "fisheye",
         (*FISHEYE[:2], 0, 0)),
        # Nerfstudio
        ({"w": 640, "h": 480, "fl_x": 500, "fl_y": 500, "cx": 320, "cy": 240, "p1": 0.0,
          "camera_model": "OPENCV_FISHEYE", **keys(FISHEYE, ("k1", "k2", "k3", "k4"))},
         "fisheye", FISHEYE),
        # Kalibr's camchain
        ({"cam0": KALIBR | {"distortion_model": "equidistant", "distortion_coeffs": FISHEYE}},
         "fisheye", FISHEYE),
        ({"cam0": KALIBR | {"distortion_model": "radtan", "distortion_coeffs": BROWN[:4]}},
         "opencv", (*BROWN[:4], 0)),
        # ROS: camera_info.yaml, the message
        ({"image_width": 640, "image_height": 480, "camera_name": "nadir",
          "camera_matrix": {"rows": 3, "cols": 3, "data": MATRIX},
          "distortion_model": "rational_polynomial",
          "distortion_coefficients": {"rows": 1, "cols": 8, "data": MILD},
          "projection_matrix": {"rows": 3, "cols": 4, "data": [0.0] * 12}}, "opencv", MILD),
        # CUAV
        ({"xresolution": 640, "yresolution": 480, "K": [MATRIX[:3], MATRIX[3:6], MATRIX[6:]],
          "D": [BROWN], "lens": 3.0, "sensorwidth": 3.68, "version": 0}, "opencv", BROWN),
        ({"width": 640, "height": 480, "distortion_model": "plumb_bob", "d": BROWN, "k": MATRIX,
          "r": [0.0] * 9, "p": [0.0] * 12}, "opencv", BROWN),
        # ROS, written by camera_calibration
        ("image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
         f"  data: {MATRIX}\ndistortion_model: rational_polynomial\n"
         f"distortion_coefficients:\n  rows: 1\n  cols: 8\n  data: {list(MILD)}\n", "opencv", MILD),
        # OpenCV's FileStorage
        ("%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
         f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {MATRIX}\n"
         "distortion_coefficients: !!opencv-matrix\n   rows: 8\n   cols: 1\n   dt: d\n"
         f"   data: {list(MILD)}\n", "opencv", MILD),
        # COLMAP's cameras.txt
        ("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
         f"1 FULL_OPENCV 640 480 500 500 320 240 {' '.join(map(str, MILD))}\n", "opencv", MILD),
    ],
)  # fmt: skip
def test_a_lens_is_read_whole(tmp_path, data, model, distortion):
    path = tmp_path / "camera"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    assert Camera.from_json(path) == Camera(
        640, 480, 500.0, 500.0, 320.0, 240.0, distortion, distortion_model=model
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "FOV", "omega": 0.9}, "'FOV' is not read; read are pinhole"),
        ({"model": "THIN_PRISM_FISHEYE", "distortion": [0.0] * 8}, "'THIN_PRISM_FISHEYE' is not"),
        ({"camera_model": "omni", "intrinsics": [1.2, 500, 500, 320, 240]}, "'omni' is not read"),
        ({"distortion_model": "inverse_brown_conrady", "distortion": BROWN}, "inverse_brown_con"),
        ({"distortion": [*BROWN, 0.1]}, "6 distortion coefficients, but the lens model opencv"),
        ({"distortion": [0.0] * 14 + [1.0]}, "15 distortion coefficients"),
        (keys(FISHEYE, ("k1", "k2", "k3", "k4")), "say by distortion_model"),
        ({"distortion_model": "plumb_bob", "D": RATIONAL}, "plumb_bob has 0 to 5"),
        ({"model": "FULL_OPENCV", "distortion": BROWN}, "FULL_OPENCV has 8"),
        ({"model": "fisheye", "distortion_model": "radtan"}, "are two lens models"),
        ({"xi": 1.2}, "xi: no coefficient of the lens model opencv"),
        ({"k1": -0.1, "b1": 0.4}, "b1: no coefficient"),
        ({"k1": -0.1, "distortion": BROWN}, "twice"),
        ({"distortion": "none"}, "expected numbers"),
        ({"camera_matrix": [[500, 2, 320], [0, 500, 240], [0, 0, 1]]}, "without skew"),
        # The rational lens of above, cut to five.
        ({"distortion": RATIONAL[:5]}, "bends a straight line .* by 10% of its length"),
        ({"distortion": [-0.9, 0, 0, 0, 0]}, "cannot be undone on .*% of the image"),
        ({"distortion": [0, 0, 0.3, 0.1, 0]}, "the order of its coefficients"),
        ({"model": "fisheye", "fx": 200.0, "fy": 200.0}, "more than 85 degrees"),
    ],
)
def test_another_lens_is_refused_by_name(change, message):
    with pytest.raises(CameraError, match=f"camera: .*{message}"):
        Camera.from_dict(PINHOLE | change)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"camera: does not exist"),
        ("[1, 2]", "width, height"),
        ('{"width": 640, "height": 480}', "missing fx, fy, cx, cy"),
        ('{"width": 640, "height": 480, "fx": "x", "fy": 1, "cx": 1, "cy": 1}', "camera"),
        ("<?xml version='1.0'?><calibration/>", "it is XML; export OpenCV's YAML"),
        ("1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE 64 48 50 50 32 24\n",
         "2 cameras; leave one line"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_camera_is_named(tmp_path, text, message):
    if text is not None:
        (tmp_path / "camera").write_text(text)
    with pytest.raises(CameraError, match=message):
        Camera.from_json(tmp_path / "camera")
