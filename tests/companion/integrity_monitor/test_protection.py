"""A protection level follows from what the deployment knows of its camera, and from when."""

from __future__ import annotations

from dataclasses import replace
from datetime import date, timedelta
from typing import Any

import numpy as np
import pytest

from companion.config import FeedConfig
from companion.integrity_monitor.config import ProtectionConfig
from companion.integrity_monitor.debouncer import AlertDebouncer, CheckResult
from companion.integrity_monitor.protection import protection_level
from mavlink_bridge.alerts.alert import Alert, AlertSpec, Severity
from mavlink_bridge.alerts.catalogue import cleared
from mavlink_bridge.alerts.ids import AlertId
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


# --- Latches: time to alert, release, repetition, and what no evidence does ---------------------


SECOND = 1_000_000_000
BAD, GOOD, UNKNOWN = CheckResult(True, 12.0), CheckResult(False), CheckResult(None)


def rule(repeat_s: float = 0.0) -> AlertSpec:
    """An alert that is raised after 1 s and cleared after 2 s."""
    return AlertSpec(
        AlertId.HEIGHT_MISMATCH, Severity.ERROR, "a fault", "fault of {metres:.0f} m",
        {"metres": "m"}, raise_s=1.0, clear_s=2.0, repeat_s=repeat_s,
    )  # fmt: skip


RAISED, OVER = Alert(AlertId.HEIGHT_MISMATCH, (12.0,)), cleared(AlertId.HEIGHT_MISMATCH)


def test_it_holds_until_good_evidence_lasts() -> None:
    """Flicker and silence do not release it."""
    debouncer = AlertDebouncer(rule())
    debouncer.update(0, BAD)
    debouncer.update(SECOND, BAD)
    assert debouncer.raised
    for k in range(2, 9):
        debouncer.update(k * SECOND, (GOOD, BAD, UNKNOWN)[k % 3])
        assert debouncer.raised
    debouncer.update(20 * SECOND, GOOD)
    assert debouncer.update(22 * SECOND, GOOD) == OVER
    assert not debouncer.raised


def test_silence_is_evidence_neither_of_a_fault_nor_of_its_end() -> None:
    """Bad, or good, once, then nothing for long, then once more has not lasted."""
    debouncer = AlertDebouncer(rule())
    for begun, found in ((0, BAD), (20, GOOD)):
        debouncer.update(begun * SECOND, found)
        for k in range(1, 10):
            debouncer.update((begun + k) * SECOND, UNKNOWN)
        assert debouncer.update((begun + 10) * SECOND, found) is None
        lasted = debouncer.update((begun + 12) * SECOND, found)
        assert lasted == (RAISED if found is BAD else OVER)
