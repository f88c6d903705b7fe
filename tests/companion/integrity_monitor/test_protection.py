"""A protection level follows from what the deployment knows of its camera, and from when."""

from __future__ import annotations

from dataclasses import replace
from datetime import date, timedelta
from typing import Any

import numpy as np
import pytest

from companion.config import FeedConfig
from companion.integrity_monitor.config import ProtectionConfig
from companion.integrity_monitor.protection import protection_level
from mavlink_bridge.messages import VehicleState, VisionFix

DONE = date(2026, 8, 1)
MODEL: Any = {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0}
AT_120_M = replace(VehicleState(), altitude_relative_m=120.0)


def feed(calibrated: date | None) -> FeedConfig:
    return FeedConfig(source="udp://127.0.0.1:5600", model=MODEL, calibrated=calibrated)


@pytest.mark.parametrize(
    ("done", "days", "known"),
    [
        (None, 0, False),
        (DONE, 0, True),
        (DONE, 90, True),
        (DONE, 91, False),  # focus, temperature and knocks since then
        (DONE, -1, False),  # a clock that was never set
    ],
)
def test_only_a_recent_calibration_says_how_well_the_camera_is_known(done, days, known):
    today = DONE + timedelta(days=days)
    assert feed(done).is_calibrated(today) is known


def level_m(sigma_m: float, *, calibrated: bool) -> float:
    fix = VisionFix(1, 47.0, 8.0, 500.0, position_covariance_ned=np.eye(3) * sigma_m**2)
    config = ProtectionConfig().of_camera(calibrated=calibrated)
    return protection_level(fix, AT_120_M, config, 0.0, 120.0).horizontal_m


def test_a_calibrated_camera_has_the_narrower_level_and_one_that_states_more_a_wider() -> None:
    """What the calibration states is in the fix's covariance: 0.1 % are 0.2 m at 120 m."""
    assert level_m(0.2, calibrated=True) < 1.5 < level_m(0.2, calibrated=False)
    assert level_m(0.6, calibrated=True) > 2.5
