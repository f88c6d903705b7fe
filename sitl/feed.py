"""Injected positions made from the simulator's truth: a companion without a camera.

For tests of vehicles, parameters and failsafes: truth plus noise and latency, with faults that can
be switched while flying. It sends on the companion's port, as component 197 of the vehicle.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.geodesy import Location
from sitl.embedded.rotation import matrix, quaternion
from sitl.pilot import Pilot, Truth

_COMPONENT = 197
_GPS_EPOCH_S = 1.4e9  # an arbitrary GPS time at boot
_LOCAL_FRD, _BODY_FRD = 20, 12
_IGNORE_VELOCITY = 8 | 16 | 32
_HALF_TICK_S = 0.005  # truth comes in whole ticks: what is due within half of one is due


class Message(Enum):
    """Which message carries the positions."""

    VISION = "VISION_POSITION_ESTIMATE"
    ODOMETRY = "ODOMETRY"
    GPS_INPUT = "GPS_INPUT"


@dataclass
class FeedConfig:
    """What is sent; may be changed in flight. Metres, seconds, radians.

    claimed_sigma_m: None sends NaN covariance. offset_ned: added to every position. reset_counter:
    sent as it is. gps_id: of GPS_INPUT.
    """

    message: Message = Message.VISION
    rate_hz: float = 10.0
    sigma_m: float = 0.5
    latency_s: float = 0.1
    claimed_sigma_m: float | None = None
    velocity_sigma: float = 0.1
    yaw_sigma: float = 0.02
    send_attitude: bool = True
    yaw_error: float = 0.0
    frame_rotation: float = 0.0
    offset_ned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reset_counter: int = 0
    on: bool = True
    gps_id: int = 0
    gps_velocity: bool = False
    quality: int = 80


@dataclass(frozen=True)
class _Fix:
    due_s: float
    taken_s: float
    position: tuple[float, float, float]
    angles: tuple[float, float, float]
    velocity: tuple[float, float, float]
    reset_counter: int


@dataclass
class TruthFeed:
    """Feeds `pilot`'s truth to a vehicle's companion port while it is open."""

    pilot: Pilot
    endpoint: str
    config: FeedConfig = field(default_factory=FeedConfig)
    origin: Location | None = None  # of the positions; None: the EKF's, as the pilot read it
    seed: int = 0
    sent: int = 0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._queue: deque[_Fix] = deque()
        self._next_s = 0.0
        self._beat_s = 0.0
        self._link = mavutil.mavlink_connection(
            self.endpoint,
            source_system=1,
            source_component=_COMPONENT,
            dialect="ardupilotmega",
            robust_parsing=True,
        )
        self.pilot.subscribe(self._on_truth)

    def jump(self, north: float, east: float, *, announced: bool) -> None:
        """Move all positions from now on; announced: with the reset_counter on the first one."""
        self.config.offset_ned = (north, east, 0.0)
        if announced:
            self.config.reset_counter += 1

    def close(self) -> None:
        """Send nothing more."""
        self.config.on = False
        self._link.close()

    def _on_truth(self, truth: Truth) -> None:
        with contextlib.suppress(OSError):
            self._drain()
            if truth.boot_s - self._beat_s >= 1.0:
                self._beat_s = truth.boot_s
                self._link.mav.heartbeat_send(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4)
            if truth.boot_s + _HALF_TICK_S >= self._next_s:
                period = 1.0 / self.config.rate_hz
                self._next_s = max(self._next_s + period, truth.boot_s)
                if self.config.on:
                    self._observe(truth)
            while self._queue and self._queue[0].due_s <= truth.boot_s + _HALF_TICK_S:
                self._send(self._queue.popleft())

    def _drain(self) -> None:
        # What the vehicle sends must be read, or its port stalls.
        while self._link.recv_msg() is not None:
            pass

    def _observe(self, truth: Truth) -> None:
        origin = self.origin or self.pilot.origin
        if origin is None:
            return
        c = self.config
        draw = self._rng.standard_normal(9)
        position = np.array(origin.ned_of(truth.location)) + c.sigma_m * draw[0:3] + c.offset_ned
        turn = matrix(quaternion(0.0, 0.0, c.frame_rotation))
        position = turn @ position
        roll, pitch, yaw = truth.roll_pitch_yaw
        angles = np.array([roll, pitch, yaw + c.yaw_error]) + c.yaw_sigma * draw[3:6]
        velocity = truth.velocity_ned + c.velocity_sigma * draw[6:9]
        self._queue.append(
            _Fix(
                truth.boot_s + c.latency_s,
                truth.boot_s,
                _three(position),
                _three(angles),
                _three(velocity),
                c.reset_counter,
            )
        )

    def _send(self, fix: _Fix) -> None:
        self.sent += 1
        if self.config.message is Message.VISION:
            self._send_vision(fix)
        elif self.config.message is Message.ODOMETRY:
            self._send_odometry(fix)
        else:
            self._send_gps(fix)

    def _covariance(self) -> list[float]:
        """Upper triangle for ArduPilot 4.7: error = cbrt(c0² + c6² + c11²)."""
        claimed = self.config.claimed_sigma_m
        if claimed is None:
            return [math.nan] * 21
        covariance = [0.0] * 21
        for i in (0, 6, 11):
            covariance[i] = math.sqrt(claimed**3 / 3)
        return covariance

    def _send_vision(self, fix: _Fix) -> None:
        angles = fix.angles if self.config.send_attitude else (math.nan,) * 3
        self._link.mav.vision_position_estimate_send(
            round(fix.taken_s * 1e6),
            *fix.position,
            *angles,
            self._covariance(),
            fix.reset_counter % 256,
        )

    def _send_odometry(self, fix: _Fix) -> None:
        q = quaternion(*fix.angles)
        body = matrix(q).T @ np.array(fix.velocity)
        self._link.mav.odometry_send(
            round(fix.taken_s * 1e6),
            _LOCAL_FRD,
            _BODY_FRD,
            *fix.position,
            [float(v) for v in q],
            *(float(v) for v in body),
            0.0,
            0.0,
            0.0,
            self._covariance(),
            [math.nan] * 21,
            fix.reset_counter % 256,
            mavlink.MAV_ESTIMATOR_TYPE_VISION,
            self.config.quality,
        )

    def _send_gps(self, fix: _Fix) -> None:
        origin = self.origin or self.pilot.origin
        if origin is None:
            return
        where = origin.offset(*fix.position)
        week, seconds = divmod(_GPS_EPOCH_S + fix.taken_s, 604_800.0)
        self._link.mav.gps_input_send(
            round(fix.taken_s * 1e6),
            self.config.gps_id,
            0 if self.config.gps_velocity else _IGNORE_VELOCITY,
            round(seconds * 1000),
            int(week),
            3,
            round(where.latitude_deg * 1e7),
            round(where.longitude_deg * 1e7),
            where.altitude_m,
            0.8,
            1.0,
            *fix.velocity,
            0.3,
            max(1.5 * self.config.sigma_m, 0.3),
            max(1.5 * self.config.sigma_m, 0.5),
            12,
            0,
        )


def _three(values: np.ndarray) -> tuple[float, float, float]:
    a, b, c = (float(v) for v in values)
    return a, b, c
