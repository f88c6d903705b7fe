"""Sends the vehicle's true pose to the world camera's process."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from companion.geometry import GimbalAngles, GimbalFrame
from localizer.map.cache.cache import TileCache
from sitl.camera.gimbal_error import GimbalError
from sitl.camera.process import WorldCameraProcess
from sitl.camera.true_motion import TruthSample
from sitl.errors import SimulationError
from sitl.geodesy import Location
from sitl.ground.pilot import Pilot

_TRUTH_PERIOD_S = 0.02


@contextmanager
def truth_feed(
    pilot: Pilot,
    camera: WorldCameraProcess,
    cache: TileCache,
    gimbal_error: GimbalError,
    map_shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Iterator[None]:
    """Context manager: a thread sends the vehicle's true pose to the world camera at 50 Hz.

    map_shift_m: offset of the map from the world (east, north, up).
    """
    shift = np.array(map_shift_m)
    stop = threading.Event()

    def feed() -> None:
        last_ns = 0
        while not stop.wait(_TRUTH_PERIOD_S):
            sample = _truth_sample(pilot, cache)
            if sample is not None and sample.time_ns > last_ns:
                last_ns = sample.time_ns
                angles = gimbal_error.true_angles(sample.gimbal, last_ns)
                place = sample.position + shift  # where that map has what is below the vehicle
                sample = replace(sample, position=place, gimbal=angles)
                try:
                    camera.send(sample)
                except SimulationError:
                    return  # the flight script sees the dead camera by its missing statistics

    thread = threading.Thread(target=feed, name="truth")
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _truth_sample(pilot: Pilot, cache: TileCache) -> TruthSample | None:
    """The newest instant at which both the vehicle and its gimbal (as it reports) are known."""
    newest = pilot.record.newest_common_ns()
    truth = pilot.record.truth_at(newest) if newest else None
    gimbal = pilot.record.gimbal_at(newest) if newest else None
    if truth is None or gimbal is None:
        return None
    roll, pitch, yaw = gimbal.roll_pitch_yaw
    frame = GimbalFrame.HEADING if gimbal.yaw_in_vehicle_frame else GimbalFrame.EARTH
    angles = GimbalAngles(roll, pitch, yaw, frame)
    return TruthSample(truth.time_ns, map_enu(truth.location, cache), truth.quaternion, angles)


def map_enu(place: Location, cache: TileCache) -> Any:
    """ENU coordinates (3,) m in the map's frame of a geodetic position (altitude AMSL)."""
    height = place.altitude_m + cache.manifest.geoid_separation_m
    return cache.frame.enu_from_geodetic(place.latitude_deg, place.longitude_deg, height)
