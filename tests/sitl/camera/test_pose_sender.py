"""The truth feed: where the camera is told to be is where the vehicle is."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.geometry import GimbalFrame
from localizer.geometry.geo import Geodetic, LocalFrame
from sitl.camera.pose_sender import truth_feed
from sitl.camera.true_motion import TruthSample
from sitl.errors import SimulationError
from sitl.geodesy import Location

ORIGIN = Geodetic(47.0, 8.0, 500.0)
SEPARATION_M = 48.0
CACHE: Any = SimpleNamespace(
    frame=LocalFrame(ORIGIN), manifest=SimpleNamespace(geoid_separation_m=SEPARATION_M)
)
LEVEL = (1.0, 0.0, 0.0, 0.0)


class _Record:
    """A vehicle that is `north_m` north of the origin and 100 m above it, at a time that runs."""

    def __init__(self, in_vehicle_frame: bool = True) -> None:
        self.now_ns: int | None = None
        self.asked: list[int] = []
        self._in_vehicle_frame = in_vehicle_frame
        place = CACHE.frame.position(np.array([30.0, 40.0, 100.0]))
        height_m = place.height_m - SEPARATION_M
        self.location = Location(place.latitude_deg, place.longitude_deg, height_m)

    def newest_common_ns(self):
        return self.now_ns

    def truth_at(self, time_ns):
        self.asked.append(time_ns)
        return SimpleNamespace(time_ns=time_ns, location=self.location, quaternion=LEVEL)

    def gimbal_at(self, time_ns):
        self.asked.append(time_ns)
        return SimpleNamespace(roll_pitch_yaw=(0.0, math.radians(-80), 0.1),
                               yaw_in_vehicle_frame=self._in_vehicle_frame)  # fmt: skip


class _Camera:
    """Takes what is sent, and wakes who waits for it; fails after `lives`."""

    def __init__(self, lives: int = 10**6) -> None:
        self.sent: list[TruthSample] = []
        self.told, self._lives = threading.Event(), lives

    def send(self, sample):
        self.sent.append(sample)
        self.told.set()
        if len(self.sent) >= self._lives:
            raise SimulationError("the world camera is gone")


class _Gimbal:
    """Off by a constant pitch."""

    def true_angles(self, reported, time_ns):
        return replace(reported, pitch_rad=reported.pitch_rad + 0.02)


def _fed(record: _Record, camera: _Camera, shift=(0.0, 0.0, 0.0)) -> Any:
    pilot: Any = SimpleNamespace(record=record)
    return truth_feed(pilot, camera, CACHE, _Gimbal(), shift)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("in_vehicle_frame", "frame"), [(True, GimbalFrame.HEADING), (False, GimbalFrame.EARTH)]
)
def test_the_camera_is_told_the_vehicles_place_on_the_map_and_the_gimbals_true_angles(
    in_vehicle_frame, frame
):
    record, camera = _Record(in_vehicle_frame), _Camera()
    record.now_ns = 5_000
    with _fed(record, camera, shift=(1.0, -2.0, 0.5)):
        assert camera.told.wait(30.0)
    sample = camera.sent[0]
    assert sample.time_ns == 5_000
    assert set(record.asked) == {5_000}  # place and angles of one instant
    # What is under the vehicle is shown by a shifted map where the vehicle would be over it.
    assert sample.position == pytest.approx([31.0, 38.0, 100.5], abs=1e-3)
    assert sample.gimbal.pitch_rad == pytest.approx(math.radians(-80) + 0.02)
    assert sample.gimbal.frame is frame


def test_an_instant_is_told_once_and_nothing_before_the_vehicle_is_known():
    record, camera = _Record(), _Camera()
    with _fed(record, camera):
        for time_ns in (1_000, 2_000):
            camera.told.clear()
            record.now_ns = time_ns
            assert camera.told.wait(30.0)
        seen = len(record.asked)
        while len(record.asked) < seen + 6:  # three turns more of the same instant
            threading.Event().wait(0.005)
    assert [s.time_ns for s in camera.sent] == [1_000, 2_000]


def test_a_dead_camera_ends_the_feed_and_not_the_flight():
    record, camera = _Record(), _Camera(lives=1)
    record.now_ns = 1_000
    with _fed(record, camera):
        assert camera.told.wait(30.0)
        record.now_ns = 2_000
    assert len(camera.sent) == 1
