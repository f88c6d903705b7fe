"""A localizer made of the simulator's truth: noise, rate, latency, and faults switched in flight.

`BridgeFeed` gives its fixes to our bridge, through the bridge's public interface. `TruthFeed` sends
MAVLink by itself on the companion's port, for what the autopilot does when nobody guards it.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import VisionFix
from mavlink_bridge import quaternion as quat
from sitl.embedded.physics.rotation import matrix, quaternion
from sitl.geodesy import Location
from sitl.ground.connection import silence
from sitl.ground.pilot import Pilot
from sitl.ground.tracks import Truth

_COMPONENT = 197
_GPS_EPOCH_S = 1.4e9  # an arbitrary GPS time at boot
_LOCAL_FRD, _BODY_FRD = 20, 12
_IGNORE_VELOCITY = 8 | 16 | 32
_ODOMETRY_SCALE = 0.1  # that the odometry claims
_FROZEN_SHARE = 0.2  # of sigma_m
_HALF_TICK_S = 0.005  # truth comes in whole ticks: what is due within half of one is due

Vector = tuple[float, float, float]


class FixModel(BaseModel):
    """How the fixes differ from the truth, when they come, and what is wrong with them.

    velocity_sigma_mps: None where no velocity is measured. rotation_deg turns the whole vision
    frame (positions and yaw) about turns_about_m (north, east of home), yaw_error_deg the yaw
    alone. frozen: the truth of the moment it began, again and again under fresh time stamps, as
    from a picture that hangs; it is registered to a fifth of `sigma_m`, since its errors are always
    the same. odometry_scale: odometry carries the position on, with such a scale error (a share).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rate_hz: float = Field(10.0, gt=0, le=50)
    sigma_m: float = Field(0.5, ge=0, description="1 sigma of each position axis")
    latency_ms: float = Field(100.0, ge=0, le=2000, description="exposure to hand-over, at least")
    latency_spread_ms: float = Field(0.0, ge=0, le=2000, description="up to so much more, drawn")
    velocity_sigma_mps: float | None = Field(None, gt=0)
    attitude_sigma_deg: float = Field(1.15, ge=0)
    rotation_deg: float = 0.0
    turns_about_m: tuple[float, float] = (0.0, 0.0)
    yaw_error_deg: float = 0.0
    offset_north_m: float = 0.0
    silent: bool = False
    frozen: bool = False
    odometry_scale: float | None = Field(None, gt=-0.5, lt=1.0)


class RawMessage(BaseModel):
    """What `TruthFeed` sends. claimed_sigma_m: None sends NaN covariance."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    message: Literal["vision_position_estimate", "odometry", "gps_input"] = (
        "vision_position_estimate"
    )
    claimed_sigma_m: float | None = Field(None, gt=0)
    attitude: bool = True
    gps_velocity: bool = False
    quality: int = Field(80, ge=-1, le=100)


@dataclass(frozen=True)
class Observation:
    """One noisy look at the truth: NED metres from an origin, radians, m/s NED."""

    position_ned: Vector
    roll_pitch_yaw: Vector
    velocity_ned: Vector


class Observer:
    """Draws observations of the truth."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._lags = np.random.default_rng([seed, 1])

    def latency_s(self, model: FixModel) -> float:
        """From an exposure to the hand-over of its fix, seconds."""
        spread = model.latency_spread_ms
        drawn = self._lags.uniform(0.0, spread) if spread else 0.0
        return (model.latency_ms + drawn) * 1e-3

    def observe(self, truth: Truth, origin: Location, model: FixModel) -> Observation:
        """What a localizer with the errors of `model` makes of the truth, about `origin`."""
        draw = self._rng.standard_normal(9)
        position = np.array(origin.ned_of(truth.location)) + model.sigma_m * draw[0:3]
        position[0] += model.offset_north_m
        turn = math.radians(model.rotation_deg)
        attitude_sigma = math.radians(model.attitude_sigma_deg)
        angles = np.array(truth.roll_pitch_yaw) + attitude_sigma * draw[3:6]
        angles[2] += math.radians(model.yaw_error_deg) + turn
        velocity = truth.velocity_ned + (model.velocity_sigma_mps or 0.0) * draw[6:9]
        about = np.array([*model.turns_about_m, 0.0])
        return Observation(
            _three(about + matrix(quaternion(0.0, 0.0, turn)) @ (position - about)),
            _three(angles),
            _three(velocity),
        )


class FixSink(Protocol):
    """Takes fixes: our bridge, or the monitor in front of it."""

    def submit(self, fix: VisionFix) -> None:
        """One fix; never blocks."""
        ...


class BridgeFeed:
    """Submits fixes, in a thread and in real time, until it is closed.

    home: the map's origin, altitude AMSL; geoid_m: the map's geoid separation there.
    """

    def __init__(
        self,
        pilot: Pilot,
        sink: FixSink,
        model: FixModel,
        home: Location,
        geoid_m: float,
        seed: int = 1,
    ) -> None:
        self.pilot = pilot
        self._sink, self._home, self._geoid_m = sink, home, geoid_m
        self._model, self._resets = model, 0
        self._hung: Truth | None = None
        self._left: Vector | None = None  # where the map ended
        self._observer = Observer(seed)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fixes", daemon=True)
        self._thread.start()

    def change(self, model: FixModel, *, reset: bool = False) -> None:
        """Another model from now on; reset: its fixes have another reset count."""
        with self._lock:
            self._model, self._resets = model, self._resets + reset

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        exposure = time.monotonic()
        while True:
            with self._lock:
                model = self._model
            exposure += 1.0 / model.rate_hz
            due = exposure + self._observer.latency_s(model)
            if self._stop.wait(max(0.0, due - time.monotonic())):
                return
            truth = self.pilot.record.truth_at(int(exposure * 1e9))
            if truth is not None and not model.silent:
                self._sink.submit(self._fix(truth))

    def _fix(self, truth: Truth) -> VisionFix:
        with self._lock:
            model, resets = self._model, self._resets
        self._hung = (self._hung or truth) if model.frozen else None
        shown, seen_as = truth, model
        if self._hung is not None:
            shown = self._hung
            seen_as = model.model_copy(update={"sigma_m": _FROZEN_SHARE * model.sigma_m})
        seen = self._observer.observe(shown, self._home, seen_as)
        place, variance = np.array(seen.position_ned), model.sigma_m**2
        self._left = None if model.odometry_scale is None else self._left or seen.position_ned
        if self._left is not None:
            way = (place - self._left) * (1.0, 1.0, 0.0)
            place = place + (model.odometry_scale or 0.0) * way
            variance += (_ODOMETRY_SCALE * float(np.hypot(*way[:2]))) ** 2
        where = self._home.offset(*_three(place))
        measured = model.velocity_sigma_mps
        return VisionFix(
            truth.time_ns,
            where.latitude_deg,
            where.longitude_deg,
            where.altitude_m + self._geoid_m,
            quat.from_euler(*seen.roll_pitch_yaw),
            np.eye(3) * variance,
            math.radians(model.attitude_sigma_deg),
            reset_count=resets,
            velocity_ned=None if measured is None else seen.velocity_ned,
            velocity_sigma_mps=measured or 0.3,
            scale_sigma=None if self._left is None else _ODOMETRY_SCALE,
        )


@dataclass(frozen=True)
class _Due:
    due_s: float
    taken_s: float
    seen: Observation
    reset_counter: int


class TruthFeed:
    """Sends MAVLink fixes on the companion's port, in simulated time, while it is open.

    origin: of the positions; None: the EKF's, as the pilot read it.
    """

    def __init__(
        self,
        pilot: Pilot,
        endpoint: str,
        model: FixModel | None = None,
        message: RawMessage | None = None,
        origin: Location | None = None,
        seed: int = 0,
    ) -> None:
        self._pilot, self._origin = pilot, origin
        self._model, self._message = model or FixModel(), message or RawMessage()
        self._observer = Observer(seed)
        self._queue: deque[_Due] = deque()
        self._next_s = self._beat_s = 0.0
        self._resets = 0
        self.sent = 0
        self._link = mavutil.mavlink_connection(
            endpoint,
            source_system=1,
            source_component=_COMPONENT,
            dialect="ardupilotmega",
            robust_parsing=True,
        )
        silence(self._link)
        pilot.record.subscribe(self._on_truth)

    def change(self, model: FixModel, *, reset: bool = False) -> None:
        """Another model from now on; reset: with the next reset_counter on its first fix."""
        self._resets += reset
        self._model = model

    def close(self) -> None:
        """Send nothing more."""
        self._model = self._model.model_copy(update={"silent": True})
        self._queue.clear()
        self._link.close()

    def _on_truth(self, truth: Truth) -> None:
        with contextlib.suppress(OSError):
            self._drain()
            if truth.boot_s - self._beat_s >= 1.0:
                self._beat_s = truth.boot_s
                self._link.mav.heartbeat_send(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4)
            if truth.boot_s + _HALF_TICK_S >= self._next_s:
                self._next_s = max(self._next_s + 1.0 / self._model.rate_hz, truth.boot_s)
                self._observe(truth)
            while self._queue and self._queue[0].due_s <= truth.boot_s + _HALF_TICK_S:
                self._send(self._queue.popleft())

    def _drain(self) -> None:
        # What the vehicle sends must be read, or its port stalls.
        while self._link.recv_msg() is not None:
            pass

    def _observe(self, truth: Truth) -> None:
        origin, model = self._origin or self._pilot.record.origin, self._model
        if origin is None or model.silent:
            return
        seen = self._observer.observe(truth, origin, model)
        due_s = truth.boot_s + self._observer.latency_s(model)
        self._queue.append(_Due(due_s, truth.boot_s, seen, self._resets % 256))

    def _send(self, due: _Due) -> None:
        self.sent += 1
        send = {
            "vision_position_estimate": self._send_vision,
            "odometry": self._send_odometry,
            "gps_input": self._send_gps,
        }
        send[self._message.message](due)

    def _covariance(self) -> list[float]:
        """Upper triangle for ArduPilot 4.7: error = cbrt(c0² + c6² + c11²)."""
        claimed = self._message.claimed_sigma_m
        if claimed is None:
            return [math.nan] * 21
        covariance = [0.0] * 21
        for i in (0, 6, 11):
            covariance[i] = math.sqrt(claimed**3 / 3)
        return covariance

    def _send_vision(self, due: _Due) -> None:
        angles = due.seen.roll_pitch_yaw if self._message.attitude else (math.nan,) * 3
        self._link.mav.vision_position_estimate_send(
            round(due.taken_s * 1e6),
            *due.seen.position_ned,
            *angles,
            self._covariance(),
            due.reset_counter,
        )

    def _send_odometry(self, due: _Due) -> None:
        q = quaternion(*due.seen.roll_pitch_yaw)
        body = matrix(q).T @ np.array(due.seen.velocity_ned)
        self._link.mav.odometry_send(
            round(due.taken_s * 1e6),
            _LOCAL_FRD,
            _BODY_FRD,
            *due.seen.position_ned,
            [float(v) for v in q],
            *_three(body),
            0.0,
            0.0,
            0.0,
            self._covariance(),
            [math.nan] * 21,
            due.reset_counter,
            mavlink.MAV_ESTIMATOR_TYPE_VISION,
            self._message.quality,
        )

    def _send_gps(self, due: _Due) -> None:
        origin = self._origin or self._pilot.record.origin
        if origin is None:
            return
        where = origin.offset(*due.seen.position_ned)
        week, seconds = divmod(_GPS_EPOCH_S + due.taken_s, 604_800.0)
        accuracy = 1.5 * self._model.sigma_m
        self._link.mav.gps_input_send(
            round(due.taken_s * 1e6),
            0,
            0 if self._message.gps_velocity else _IGNORE_VELOCITY,
            round(seconds * 1000),
            int(week),
            3,
            round(where.latitude_deg * 1e7),
            round(where.longitude_deg * 1e7),
            where.altitude_m,
            0.8,
            1.0,
            *due.seen.velocity_ned,
            0.3,
            max(accuracy, 0.3),
            max(accuracy, 0.5),
            12,
            0,
        )


def _three(values: Any) -> Vector:
    a, b, c = (float(v) for v in values)
    return a, b, c
