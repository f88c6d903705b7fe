"""A vehicle without links that runs as fast as it can, and injects straight into its inputs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.control.mode import Mode
from sitl.embedded.mavlink.server import JitterCorrection, MavlinkServer
from sitl.embedded.parameters import Parameters, Px4Parameters
from sitl.embedded.physics.rotation import euler
from sitl.embedded.vehicle import EmbeddedVehicle
from sitl.geodesy import Location

HOME = Location(47.397742, 8.545594, 488.0)


@dataclass
class Vision:
    """VISION_POSITION_ESTIMATE from truth, 10 Hz and 100 ms late unless told otherwise."""

    bench: Bench
    sigma: float = 0.3
    period_ticks: int = 10
    latency_ticks: int = 10
    on: bool = True
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: float = 0.0
    reset_counter: int = 0
    covariance: list[float] = field(default_factory=lambda: [math.nan] * 21)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(7)
        self._jitter = JitterCorrection()
        self._queue: list[tuple[int, object]] = []

    def __call__(self) -> None:
        v = self.bench.vehicle
        if self.on and v.tick % self.period_ticks == 0:
            origin = v.estimator.origin or HOME
            n, e, d = np.array(origin.ned_of(v.true_location)) + self._rng.normal(0, self.sigma, 3)
            n, e, d = n + self.offset[0], e + self.offset[1], d + self.offset[2]
            c, s = math.cos(self.rotation), math.sin(self.rotation)
            message = mavlink.MAVLink_vision_position_estimate_message(
                v.time_ms * 1000,
                c * n - s * e,
                s * n + c * e,
                d,
                *euler(v.truth[6:10]),
                self.covariance,
                self.reset_counter,
            )
            self._queue.append((v.tick + self.latency_ticks, message))
        while self._queue and self._queue[0][0] <= v.tick:
            message = self._queue.pop(0)[1]
            v.injection.vision(message, self._jitter, v.time_ms)


class Listened(MavlinkServer):
    """Links to nobody; what the vehicle says on all of them is noted."""

    def __init__(self, note: Callable[[str], None]) -> None:
        super().__init__((), 1)
        self._note_text = note

    def broadcast(self, message: Any) -> None:
        if message.get_type() == "STATUSTEXT":
            self._note_text(str(message.text))


class Bench:
    def __init__(self, parameters: dict[str, float], seed: int = 1, px4: bool = False) -> None:
        table = Px4Parameters() if px4 else Parameters()
        for name, value in parameters.items():
            assert table.set(name, value), name
        self.texts: list[tuple[float, str]] = []
        self.whole = EmbeddedVehicle(HOME, 30.0, table, Listened(self._note), seed)
        self.vehicle = self.whole.aircraft
        self.each_tick: list[Callable[[], None]] = []

    def _note(self, text: str) -> None:
        self.texts.append((self.vehicle.time_s, text))

    def vision(self, **options: object) -> Vision:
        feed = Vision(self, **options)  # type: ignore[arg-type]
        self.each_tick.append(feed)
        return feed

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        for _ in range(round(seconds * 100)):
            for hook in self.each_tick:
                hook()
            self.whole.step()
            if until():
                return True
        return False

    @property
    def truth(self) -> np.ndarray:
        """NED about home."""
        return self.vehicle.truth[0:3].copy()

    def ekf_error(self) -> float:
        """Horizontal metres between estimate and truth."""
        v = self.vehicle
        n, e, _ = v.estimator.origin.ned_of(v.true_location)
        return math.hypot(v.estimator.position[0] - n, v.estimator.position[1] - e)

    def errors(self, seconds: float) -> np.ndarray:
        """Horizontal EKF errors of each tick of a stretch."""
        errors = []

        def note() -> bool:
            errors.append(self.ekf_error())
            return False

        self.run(seconds, note)
        return np.array(errors)

    def said(self, part: str) -> bool:
        return any(part in text for _, text in self.texts)

    def time_of(self, part: str) -> float:
        return next(time for time, text in self.texts if part in text)

    def take_off(self, height: float = 30.0) -> None:
        """Arm in GUIDED as soon as it will, and climb."""
        modes = self.vehicle.modes
        assert modes.set_mode(Mode.GUIDED)
        assert self.run(90, lambda: self.vehicle.tick % 50 == 0 and not self.failures()), (
            self.failures()
        )
        modes.arm()
        assert modes.takeoff(height)
        assert self.run(60, lambda: self.truth[2] < -(height - 0.5))

    def failures(self) -> list[str]:
        return self.vehicle.arming_failures()

    def go(self, north: float, east: float, height: float) -> None:
        """Guided target about home; does not wait."""
        v = self.vehicle
        origin = v.estimator.origin
        down = v.modes.home.altitude_m if v.modes.home else HOME.altitude_m
        n, e, _ = origin.ned_of(HOME)
        z = origin.altitude_m - down - height
        assert v.modes.go_to_local((n + north, e + east, z))


@pytest.fixture
def bench() -> Callable[..., Bench]:
    return Bench


VISION_ONLY = {
    "GPS1_TYPE": 0,
    "VISO_TYPE": 1,
    "VISO_POS_M_NSE": 0.5,
    "VISO_DELAY_MS": 100,
    "EK3_SRC1_POSXY": 6,
    "EK3_SRC1_VELXY": 0,
    "EK3_SRC1_VELZ": 0,
}


@pytest.fixture
def vision_only() -> dict[str, float]:
    return dict(VISION_ONLY)


@pytest.fixture
def home() -> Location:
    return HOME
