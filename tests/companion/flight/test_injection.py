"""Which estimates become fixes, which of them carries a jump, and who may withhold one."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.calibration_watch.observation import CalibrationObservation
from companion.conversions import CameraExtrinsics, camera_view, vision_fix
from companion.flight.calibration_observer import CalibrationObserver, middle_depth_m
from companion.flight.channels import FixInjection
from companion.ground.vital_signs import ViewReporter
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, matrix_from_euler
from localizer.map.cache.pick import BundleHits
from localizer.types import PoseEstimate, TrackingState
from mavlink_bridge.alerts.catalogue import alert, cleared
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.camera.messages import camera_fov_status
from mavlink_bridge.config import CameraConfig
from tests.companion.estimates import DOWN, estimated

LOST, TRACKING = TrackingState.LOST, TrackingState.TRACKING
DEGRADED, INITIALIZING = TrackingState.DEGRADED, TrackingState.INITIALIZING
BRIDGING = TrackingState.BRIDGING
FRAME = LocalFrame(Geodetic(47.0, 8.0, 500.0))
EXTRINSICS = CameraExtrinsics(FRAME, 47.0, np.zeros(3))


class FakeBridge:
    def __init__(self):
        self.fixes = []
        self.said = []

    def report_alert(self, alert):
        self.said.append(alert)

    def attitude_at(self, _):
        return None

    def gimbal_at(self, _):
        return None

    def submit(self, fix):
        self.fixes.append(fix)


def _estimate(state, accepted=True):
    scale_sigma = 0.2 if state is BRIDGING else None
    return estimated(state=state, accepted=accepted, scale_sigma=scale_sigma)


@pytest.mark.parametrize(
    ("states", "counts"),
    [
        ((INITIALIZING, TRACKING, TRACKING), [1, 1]),
        ((TRACKING, DEGRADED, TRACKING), [1, 1]),  # it kept the filter's track
        ((TRACKING, LOST, LOST, INITIALIZING, TRACKING, TRACKING), [1, 2, 2]),
        # What odometry drifted by ends where the map is found again.
        ((TRACKING, BRIDGING, BRIDGING, TRACKING, TRACKING), [1, 1, 1, 2, 2]),
    ],
)
def test_only_a_new_start_is_a_jump(states, counts):
    bridge = FakeBridge()
    injection = FixInjection(bridge, EXTRINSICS)
    for state in states:
        injection.add_estimate(_estimate(state), None)
    assert [fix.reset_count for fix in bridge.fixes] == counts
    sent = [state for state in states if state in (TRACKING, BRIDGING)]
    scales = [fix.scale_sigma for fix in bridge.fixes]  # a fix of the odometry says so
    assert scales == [0.2 if state is BRIDGING else None for state in sent]


def test_what_is_rejected_or_unconfirmed_is_not_injected():
    bridge = FakeBridge()
    injection = FixInjection(bridge, EXTRINSICS)
    injection.add_estimate(_estimate(TRACKING, accepted=False), None)
    for state in (INITIALIZING, DEGRADED, LOST):
        injection.add_estimate(_estimate(state), None)
    assert bridge.fixes == []


def test_a_judge_withholds_or_widens_and_observers_see_each_fix_as_it_was_made():
    bridge, seen, verdicts = FakeBridge(), [], iter([None, "wider", "as it is"])
    injection = FixInjection(bridge, EXTRINSICS)

    def judge(fix):
        verdict = next(verdicts)
        if verdict == "wider":
            return replace(fix, position_covariance_ned=4.0 * fix.position_covariance_ned)
        return fix if verdict else None

    injection.add_check(judge)
    injection.add_observer(lambda _estimate, _bundle, fix: seen.append(fix))
    for _ in range(3):
        injection.add_estimate(_estimate(TRACKING), None)
    widths = [fix.position_covariance_ned[0, 0] for fix in bridge.fixes]
    assert widths == pytest.approx([4e-4, 1e-4])
    assert [fix.position_covariance_ned[0, 0] for fix in seen] == pytest.approx([1e-4] * 3)


def test_a_judge_that_raises_withholds_and_is_told_and_its_end_too():
    bridge, broken = FakeBridge(), [False]

    def judge(fix):
        if broken[0]:
            raise ZeroDivisionError
        return fix

    injection = FixInjection(bridge, EXTRINSICS)
    injection.add_check(judge)
    for tenth in range(300):
        broken[0] = 100 <= tenth < 130 or (tenth > 200 and tenth % 2 == 0)
        estimate = replace(_estimate(TRACKING), exposure_time_ns=10**9 + tenth * 10**8)
        injection.add_estimate(estimate, None)
    assert len(bridge.fixes) == 300 - 30 - 49
    assert bridge.said == [
        alert(AlertId.FIXES_NOT_CHECKED), cleared(AlertId.FIXES_NOT_CHECKED),
        alert(AlertId.FIXES_NOT_CHECKED),
    ]  # fmt: skip


# --- Which estimates become evidence of the calibration, and what they say ----------------------


def test_four_a_second_of_what_the_map_confirmed() -> None:
    taken: list[CalibrationObservation] = []
    observer = CalibrationObserver(EXTRINSICS, taken.append)

    def see(time_s: float, depth_m: float = 80.0, state: TrackingState = TRACKING) -> None:
        pose = Pose(DOWN, np.array([0.0, 0.0, 80.0]))
        seen = estimated(pose, round(time_s * 1e9), variance=0.04, state=state)
        view = SimpleNamespace(depth=np.full((240, 320), depth_m, np.float32))
        bundle: Any = SimpleNamespace(view=view)
        observer.add_fix(seen, bundle, vision_fix(seen, EXTRINSICS, None, None, 1))

    for tenth in range(1, 21):
        see(0.1 * tenth)
    assert 6 <= len(taken) <= 8
    see(6.0, state=BRIDGING)
    see(7.0, depth_m=0.0)
    assert taken[-1].time_ns < 5e9
    one = taken[0]
    assert one.place == pytest.approx((47.0, 8.0, 580.0), abs=1e-6)
    assert one.sigma_m == pytest.approx(0.2)
    assert one.depth_m == 80.0
    assert one.ned_from_camera[:, 2] == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)


def test_the_depth_is_that_of_the_ground_in_the_middle() -> None:
    depth = np.full((240, 320), 500.0, np.float32)
    depth[60:180, 80:240] = 90.0
    depth[100:110, 100:110] = 10.0  # a mast
    assert middle_depth_m(depth) == 90.0
    depth[60:170] = 0.0
    assert middle_depth_m(depth) is None


# --- What the ground is told about the camera's view --------------------------------------------


# OpenCV axes of a camera at the horizon that looks north, in ENU.
NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def estimate_view_reporter(
    pitch_deg: float, *, accepted: bool = True, time_ns: int = 5
) -> PoseEstimate:
    """100 m above the origin, looking north and `pitch_deg` above the horizon."""
    rotation = matrix_from_euler(math.radians(pitch_deg), 0.0, 0.0) @ NORTH
    return estimated(Pose(rotation, np.array([0.0, 0.0, 100.0])), time_ns, accepted=accepted)


def flat(origin, directions):
    distances = np.where(directions[:, 2] < 0.0, -origin[2] / directions[:, 2], np.nan)
    return BundleHits(distances, np.tile([0.0, 0.0, 1.0], (len(directions), 1)))


def test_the_picture_s_centre_falls_on_the_ground():
    view = camera_view(estimate_view_reporter(-45.0), FRAME, flat)
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
    sky = camera_view(estimate_view_reporter(10.0), FRAME, flat)
    assert (sky.image_latitude_deg, sky.image_height_m) == (None, None)


def test_the_field_of_view_is_that_of_the_zoom():
    zoomed = replace(estimate_view_reporter(-45.0), camera=Camera.from_fov(640, 480, 20))
    view = camera_view(zoomed, FRAME, flat)
    sent = camera_fov_status(view, CameraConfig(horizontal_fov_deg=60.0), 0.0, 0)
    assert (sent.hfov, sent.vfov) == pytest.approx((20.0, zoomed.camera.vertical_fov_deg))


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
    reporter.add_estimate(estimate_view_reporter(-45.0))
    assert failed.wait(30.0)
    reporter.add_estimate(estimate_view_reporter(-45.0, accepted=False, time_ns=6))
    reporter.add_estimate(estimate_view_reporter(-45.0, time_ns=7))
    assert came.wait(30.0)
    reporter.stop()
    assert [view.time_ns for view in views] == [7]
