"""The simulated operator's eye: what it can see, and the errors that it makes."""

import json
import socket
from collections import Counter

import numpy as np
import pytest

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from sitl.camera.detector import Detector, DetectorErrors, DetectorView, FixedPoint

CAMERA = Camera.from_fov(320, 240, 60.0)
# 50 m up, looking down: x east, y south.
POSE = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 50.0]))
EXACT = DetectorErrors(noise_px=0.0)


@pytest.fixture
def listener():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        s.settimeout(2.0)
        yield s


def _eye(listener, targets, errors=EXACT):
    return Detector(f"127.0.0.1:{listener.getsockname()[1]}", CAMERA, targets, errors, seed=1)


def _view(depth=50.0, time_ns=7, pose_of_row=lambda _: POSE):
    return DetectorView(time_ns, np.full((240, 320), depth, np.float32), pose_of_row)


def test_a_visible_target_is_sent_where_it_projects(listener):
    eye = _eye(listener, [FixedPoint("a", np.array([4.0, 3.0, 0.0]))])
    (seen,) = eye.observe(_view(), stamp_ns=11)
    pixel, _ = CAMERA.project(POSE.inverse.apply(np.array([4.0, 3.0, 0.0])))
    assert (seen.u, seen.v) == pytest.approx(pixel)
    message = json.loads(listener.recv(2000))
    assert message["time_ns"] == 11  # of the frame in the stream, not of its exposure
    eye.close()


@pytest.mark.parametrize(
    ("place", "depth"),
    [
        ((4.0, 3.0, 0.0), 40.0),  # behind a roof 10 m above it
        ((400.0, 3.0, 0.0), 50.0),  # outside
        ((28.8, 0.0, 0.0), 50.0),  # on the very edge of the picture
        ((0.0, 0.0, 60.0), 50.0),  # above the camera
    ],
)
def test_what_nobody_could_see_is_not_reported(listener, place, depth):
    eye = _eye(listener, [FixedPoint("a", np.array(place))])
    assert eye.observe(_view(depth)) == []
    eye.close()


def test_misses_false_ones_and_exchanged_names_come_as_often_as_said(listener):
    places = {"a": np.array([4.0, 3.0, 0.0]), "b": np.array([-6.0, -5.0, 0.0])}
    errors = DetectorErrors(noise_px=0.0, missed=0.2, false=0.1, swapped=0.15)
    eye = _eye(listener, [FixedPoint(n, p) for n, p in places.items()], errors)
    true = {n: CAMERA.project(POSE.inverse.apply(p))[0] for n, p in places.items()}
    count: Counter[str] = Counter()
    for _ in range(2000):
        for d in eye.observe(_view()):
            if d.target_id.startswith("no-target"):
                count["false"] += 1
                continue
            near = [n for n, p in true.items() if np.hypot(d.u - p[0], d.v - p[1]) < 0.01]
            count["right" if near == [d.target_id] else "swapped"] += 1
    seen = 2 * 2000 * 0.8
    assert count["false"] == pytest.approx(2000 * 0.1 * 0.96, rel=0.25)
    assert count["swapped"] == pytest.approx(2 * 2000 * 0.64 * 0.15, rel=0.25)
    assert count["right"] == pytest.approx(seen - count["swapped"], rel=0.08)
    eye.close()
