"""CAMERA_SETTINGS: the zoom at the time of a picture, and what is not known of it."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig, CameraConfig
from mavlink_bridge.vehicle.streams import wanted_streams
from mavlink_bridge.vehicle.tracker import VehicleTracker
from tests.mavlink_bridge.vehicle.test_tracker import SECOND, sent, tracker

CAMERA = 100
HOLD_S = 2.0


def zoom(it: VehicleTracker, at_s: float, level: float, component: int = CAMERA) -> None:
    message = sent(mavlink.MAVLink_camera_settings_message(0, 1, level, 0.0), component=component)
    if it.accepts(message):
        it.handle(message, round(at_s * SECOND))


def at(it: VehicleTracker, at_s: float, hold_s: float = HOLD_S) -> float | None:
    return it.zoom_at(round(at_s * SECOND), hold_s)


def test_the_level_of_a_picture_lies_between_two_reports() -> None:
    it = tracker()
    assert at(it, 10.0) is None
    zoom(it, 10.0, 20.0)
    zoom(it, 10.2, 30.0)
    assert at(it, 9.9) is None
    assert at(it, 10.1) == pytest.approx(25.0)


def test_a_lens_that_rests_is_known_longer_than_one_that_moves() -> None:
    it = tracker()
    zoom(it, 10.0, 20.0)
    assert at(it, 11.9) == 20.0
    assert at(it, 12.1) is None
    zoom(it, 12.2, 30.0)
    assert at(it, 12.6) == 30.0
    assert at(it, 12.8) is None  # nobody knows where it has moved since
    assert at(it, 11.5) is None  # nor when between two reports that lie far apart


def test_a_level_that_is_not_known_or_none_is_not_taken() -> None:
    it = tracker()
    zoom(it, 10.0, 20.0)
    zoom(it, 10.1, 1e9)
    assert at(it, 10.2) == 20.0
    assert it.ignored == 1
    zoom(it, 10.3, math.nan)
    assert at(it, 10.4) is None


def test_a_second_camera_of_the_vehicle_does_not_zoom_the_first() -> None:
    it = tracker()
    zoom(it, 10.0, 20.0)
    zoom(it, 10.1, 90.0, component=101)
    assert at(it, 10.2) == 20.0


def test_it_is_asked_for_where_a_table_waits_for_it() -> None:
    names = {s.name for s in wanted_streams(BridgeConfig(), "ardupilot")}
    assert "CAMERA_SETTINGS" not in names
    config = BridgeConfig(camera=CameraConfig(zoom_rate_hz=5.0))
    assert "CAMERA_SETTINGS" in {s.name for s in wanted_streams(config, "ardupilot")}
