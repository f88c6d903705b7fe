"""CAMERA_SETTINGS: the zoom at the time of a picture, and what is not known of it."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.vehicle.tracker import VehicleTracker
from tests.mavlink_bridge.simulated import SECOND
from tests.mavlink_bridge.vehicle.test_tracker import sent, tracker


def zoom(it: VehicleTracker, at_s: float, level: float, component: int = 100) -> None:
    message = sent(mavlink.MAVLink_camera_settings_message(0, 1, level, 0.0), component=component)
    assert it.accepts(message)
    it.handle(message, round(at_s * SECOND))


def at(it: VehicleTracker, at_s: float) -> float | None:
    return it.zoom_at(round(at_s * SECOND), 2.0)


def test_a_lens_that_rests_is_known_longer_than_one_that_moves() -> None:
    it = tracker()
    assert at(it, 10.0) is None
    zoom(it, 10.0, 20.0)
    assert (at(it, 9.9), at(it, 11.9), at(it, 12.1)) == (None, 20.0, None)
    zoom(it, 12.2, 30.0)
    assert at(it, 12.6) == 30.0
    assert at(it, 12.8) is None  # nobody knows where it has moved since
    assert at(it, 11.5) is None  # nor when between two reports that lie far apart
    zoom(it, 12.4, 40.0)
    assert at(it, 12.3) == pytest.approx(35.0)


def test_a_level_that_is_not_known_or_of_a_second_camera_is_not_taken() -> None:
    it = tracker()
    zoom(it, 10.0, 20.0)
    zoom(it, 10.1, 90.0, component=101)
    zoom(it, 10.1, 1e9)
    assert at(it, 10.2) == 20.0
    assert it.ignored == 1
    zoom(it, 10.3, math.nan)
    assert at(it, 10.4) is None
