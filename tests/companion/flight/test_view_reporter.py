"""What the ground is told about the camera's view."""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest

from companion.conversions import camera_view
from companion.flight.view_reporter import ViewReporter
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, matrix_from_euler
from localizer.map.cache.pick import BundleHits
from localizer.types import PoseEstimate
from mavlink_bridge.camera.messages import camera_fov_status
from mavlink_bridge.config import CameraConfig
from tests.companion.estimates import estimated

FRAME = LocalFrame(Geodetic(47.0, 8.0, 500.0))
# OpenCV axes of a camera at the horizon that looks north, in ENU.
NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def estimate(pitch_deg: float, *, accepted: bool = True, time_ns: int = 5) -> PoseEstimate:
    """100 m above the origin, looking north and `pitch_deg` above the horizon."""
    rotation = matrix_from_euler(math.radians(pitch_deg), 0.0, 0.0) @ NORTH
    return estimated(Pose(rotation, np.array([0.0, 0.0, 100.0])), time_ns, accepted=accepted)


def flat(origin, directions):
    distances = np.where(directions[:, 2] < 0.0, -origin[2] / directions[:, 2], np.nan)
    return BundleHits(distances, np.tile([0.0, 0.0, 1.0], (len(directions), 1)))


def test_the_picture_s_centre_falls_on_the_ground():
    view = camera_view(estimate(-45.0), FRAME, flat)
    assert (view.latitude_deg, view.longitude_deg) == pytest.approx((47.0, 8.0))
    assert view.height_m == pytest.approx(600.0, abs=0.01)
    # 45 deg down from 100 m meets the ground 100 m to the north: 1 deg of latitude is 111.17 km.
    assert view.image_latitude_deg is not None
    assert (view.image_latitude_deg - 47.0) * 111_170 == pytest.approx(100.0, abs=0.5)
    assert view.image_longitude_deg == pytest.approx(8.0, abs=1e-9)
    assert view.image_height_m == pytest.approx(500.0, abs=0.01)
    # Nose down about the right-hand axis: (cos, 0, sin, 0) of half the pitch.
    half = math.radians(-45.0) / 2.0
    q = np.array(view.quaternion_ned)
    assert abs(q @ [math.cos(half), 0.0, math.sin(half), 0.0]) == pytest.approx(1.0, abs=1e-6)


def test_the_field_of_view_is_that_of_the_zoom():
    zoomed = replace(estimate(-45.0), camera=Camera.from_fov(640, 480, 20))
    view = camera_view(zoomed, FRAME, flat)
    sent = camera_fov_status(view, CameraConfig(horizontal_fov_deg=60.0), 0.0, 0)
    assert (sent.hfov, sent.vfov) == pytest.approx((20.0, zoomed.camera.vertical_fov_deg))


def test_a_look_into_the_sky_has_no_ground():
    view = camera_view(estimate(10.0), FRAME, flat)
    assert view.image_latitude_deg is None
    assert view.image_height_m is None


def test_only_the_newest_accepted_estimate_is_told_and_errors_do_not_end_it():
    views, came, failed = [], threading.Event(), threading.Event()

    def cast(origin, direction):
        if not failed.is_set():
            failed.set()
            raise RuntimeError("map is being loaded")
        return flat(origin, direction)

    def look(view):
        views.append(view)
        came.set()

    reporter = ViewReporter(200.0, FRAME, cast, look)
    reporter.start()
    reporter.add_estimate(estimate(-45.0))
    assert failed.wait(30.0)
    reporter.add_estimate(estimate(-45.0, accepted=False, time_ns=6))
    reporter.add_estimate(estimate(-45.0, time_ns=7))
    assert came.wait(30.0)
    reporter.stop()
    assert [view.time_ns for view in views] == [7]
