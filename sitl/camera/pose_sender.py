"""Sends the vehicle's true pose to the world camera's process; the gimbal reports with errors."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from companion.geometry import GimbalAngles, GimbalFrame
from localizer.map.cache.cache import TileCache
from sitl.camera.process import WorldCameraProcess
from sitl.camera.true_motion import TruthSample
from sitl.errors import SimulationError
from sitl.geodesy import Location
from sitl.ground.pilot import Pilot

_ALIGNMENT_SIGMA = np.radians(0.5)  # per axis, constant over a flight: mounting and calibration
_WANDER_SIGMA = np.radians(0.3)  # per axis: the attitude estimate it is stabilised with
_WANDER_TIME_S = 6.0


class GimbalError:
    """Converts reported gimbal angles to true ones: adds a constant and a first-order Gauss-Markov
    process.

    fault_rad: an additional gross error (roll, pitch, yaw).
    """

    def __init__(self, seed: int, fault_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self._rng = np.random.default_rng([seed, 17])
        self._alignment = self._rng.normal(0.0, _ALIGNMENT_SIGMA, 3) + np.array(fault_rad)
        self._wander = self._rng.normal(0.0, _WANDER_SIGMA, 3)
        self._time_ns: int | None = None

    @property
    def alignment_deg(self) -> tuple[float, float, float]:
        """The constant part: roll, pitch, yaw."""
        roll, pitch, yaw = np.degrees(self._alignment)
        return float(roll), float(pitch), float(yaw)

    def true_angles(self, reported: GimbalAngles, time_ns: int) -> GimbalAngles:
        """The true angles at a time; times must not decrease."""
        self._advance(time_ns)
        roll, pitch, yaw = self._alignment + self._wander
        return replace(
            reported,
            roll_rad=reported.roll_rad + roll,
            pitch_rad=reported.pitch_rad + pitch,
            yaw_rad=reported.yaw_rad + yaw,
        )

    def _advance(self, time_ns: int) -> None:
        elapsed_s = 0.0 if self._time_ns is None else (time_ns - self._time_ns) * 1e-9
        self._time_ns = time_ns
        kept = np.exp(-elapsed_s / _WANDER_TIME_S)
        drive = self._rng.normal(0.0, _WANDER_SIGMA * np.sqrt(1.0 - kept**2), 3)
        self._wander = kept * self._wander + drive


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
