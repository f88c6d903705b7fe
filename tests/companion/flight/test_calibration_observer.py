"""Which estimates become evidence of the calibration, and what they say."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.calibration_watch.observation import CalibrationObservation
from companion.conversions import CameraExtrinsics, vision_fix
from companion.flight.calibration_observer import CalibrationObserver, middle_depth_m
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.types import PoseEstimate, TrackingState
from tests.companion.estimates import DOWN, estimated

FRAME = LocalFrame(Geodetic(47.0, 8.0, 500.0))
EXTRINSICS = CameraExtrinsics(FRAME, 47.0, np.zeros(3))


def bundle(depth: np.ndarray) -> Any:
    return SimpleNamespace(view=SimpleNamespace(depth=depth))


def estimate(time_s: float, *, state: str = "TRACKING") -> PoseEstimate:
    pose = Pose(DOWN, np.array([0.0, 0.0, 80.0]))
    return estimated(pose, round(time_s * 1e9), variance=0.04, state=TrackingState[state])


def test_four_a_second_of_what_the_map_confirmed() -> None:
    taken: list[CalibrationObservation] = []
    observer = CalibrationObserver(EXTRINSICS, taken.append)

    def see(seen: PoseEstimate, depth: np.ndarray) -> None:
        observer.add_fix(seen, bundle(depth), vision_fix(seen, EXTRINSICS, None, None, 1))

    depth = np.full((240, 320), 80.0, np.float32)
    for tenth in range(1, 21):
        see(estimate(0.1 * tenth), depth)
    assert 6 <= len(taken) <= 8
    see(estimate(6.0, state="BRIDGING"), depth)
    see(estimate(7.0), np.zeros((240, 320), np.float32))
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
