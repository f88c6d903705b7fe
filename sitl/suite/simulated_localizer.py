"""Simulated localizer: makes fixes from the truth, with noise, latency and faults.

`BridgeFeed` submits the fixes to the bridge through its public interface.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from mavlink_bridge import VisionFix
from mavlink_bridge import quaternion as quat
from sitl.embedded.physics.rotation import matrix, quaternion
from sitl.geodesy import Location
from sitl.ground.pilot import Pilot
from sitl.ground.tracks import Truth

_ODOMETRY_SCALE = 0.1  # that the odometry claims
_FROZEN_SHARE = 0.2  # of sigma_m

Vector = tuple[float, float, float]


class FixModel(BaseModel):
    """Rate, noise, latency and faults of simulated fixes.

    velocity_sigma_mps: None: fixes have no velocity. rotation_deg rotates the whole vision frame
    (positions and yaw) about turns_about_m (north, east of home). yaw_error_deg rotates the yaw
    alone. silent: no fix is sent. frozen: the true position at its start is sent again and again
    with new timestamps, as from a frozen frame; its noise is a fifth of `sigma_m`, because the
    error of one frame is constant. odometry_scale: relative scale error of the way since odometry
    began; None: no odometry.
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


class BridgeFeed:
    """Submits fixes in a thread, in real time, from when it is made until it is closed.

    pilot: gives the truth; may be replaced. submit: takes each fix and never blocks. home: the
    map's origin, altitude AMSL; geoid_m: the map's geoid separation there.
    """

    def __init__(
        self,
        pilot: Pilot,
        submit: Callable[[VisionFix], None],
        model: FixModel,
        home: Location,
        geoid_m: float,
        seed: int = 1,
    ) -> None:
        self.pilot = pilot
        self._submit, self._home, self._geoid_m = submit, home, geoid_m
        self._model, self._resets = model, 0
        self._hung: Truth | None = None
        self._left: Vector | None = None  # where the map ended
        self._rng = np.random.default_rng(seed)
        self._lags = np.random.default_rng([seed, 1])
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fixes", daemon=True)
        self._thread.start()

    def change(self, model: FixModel, *, reset: bool = False) -> None:
        """Use another model from now on. reset: increment the fixes' reset count."""
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
            due = exposure + self._latency_s(model)
            if self._stop.wait(max(0.0, due - time.monotonic())):
                return
            truth = self.pilot.record.truth_at(int(exposure * 1e9))
            if truth is not None and not model.silent:
                self._submit(self._fix(truth))

    def _latency_s(self, model: FixModel) -> float:
        """Random latency from exposure to submission of a fix."""
        spread = model.latency_spread_ms
        drawn = self._lags.uniform(0.0, spread) if spread else 0.0
        return (model.latency_ms + drawn) * 1e-3

    def _observed(self, truth: Truth, model: FixModel, sigma_m: float) -> tuple[Any, Any, Any]:
        """A noisy pose of `truth`, each (3,): NED metres from home, Euler angles, NED m/s."""
        draw = self._rng.standard_normal(9)
        turn = math.radians(model.rotation_deg)
        place = np.array(self._home.ned_of(truth.location)) + sigma_m * draw[0:3]
        place[0] += model.offset_north_m
        about = np.array([*model.turns_about_m, 0.0])
        place = about + matrix(quaternion(0.0, 0.0, turn)) @ (place - about)
        angles = np.array(truth.roll_pitch_yaw) + math.radians(model.attitude_sigma_deg) * draw[3:6]
        angles[2] += math.radians(model.yaw_error_deg) + turn
        velocity = truth.velocity_ned + (model.velocity_sigma_mps or 0.0) * draw[6:9]
        return place, angles, velocity

    def _fix(self, truth: Truth) -> VisionFix:
        with self._lock:
            model, resets = self._model, self._resets
        self._hung = (self._hung or truth) if model.frozen else None
        shown, sigma_m = truth, model.sigma_m
        if self._hung is not None:
            shown, sigma_m = self._hung, _FROZEN_SHARE * model.sigma_m
        place, angles, velocity = self._observed(shown, model, sigma_m)
        variance = model.sigma_m**2
        self._left = None if model.odometry_scale is None else self._left or _three(place)
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
            quat.from_euler(*_three(angles)),
            np.eye(3) * variance,
            math.radians(model.attitude_sigma_deg),
            reset_count=resets,
            velocity_ned=None if measured is None else _three(velocity),
            velocity_sigma_mps=measured or 0.3,
            scale_sigma=None if self._left is None else _ODOMETRY_SCALE,
        )


def _three(values: Any) -> Vector:
    a, b, c = (float(v) for v in values)
    return a, b, c
