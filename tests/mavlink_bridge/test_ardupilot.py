"""Flights of the bridge against the real ArduCopter, at real speed; the figures are measured here.

The position is the simulator's truth with noise and latency; everything else is the product's: the
bridge on serial1, the origin, the messages. Limits are the table of docs/bridge.md plus 25 %.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from mavlink_bridge import Bridge, BridgeConfig, VisionFix
from mavlink_bridge.config import InjectionConfig, OriginConfig, SourceSwitchConfig
from mavlink_bridge.doctor import examine, repair
from mavlink_bridge.origin import METRES_PER_DEGREE
from sitl.ardupilot import ArduPilotSitl, find_arducopter
from sitl.embedded.geodesy import Location
from sitl.pilot import Pilot
from sitl.vehicles import (
    GIMBAL,
    GPS_OFF,
    SPEEDS,
    gps_input_only_parameters,
    vision_only_parameters,
    vision_parameters,
)

pytestmark = [
    pytest.mark.sitl,
    pytest.mark.skipif(find_arducopter() is None, reason="no arducopter binary"),
]

HOME = Location(47.397742, 8.545594, 488.0)
GEOID = 47.3
ORIGIN = OriginConfig(
    latitude_deg=HOME.latitude_deg,
    longitude_deg=HOME.longitude_deg,
    altitude_amsl_m=HOME.altitude_m,
)
HEIGHT = 60.0
SIDE = 120.0


@dataclass
class Feed:
    """A localizer made of truth: noise, latency, rate, and faults that a test switches."""

    pilot: Pilot
    bridge: Bridge
    rate_hz: float = 10.0
    sigma_m: float = 0.5
    latency_s: float = 0.08
    rotation_deg: float = 0.0
    jump_north_m: float = 0.0
    velocity_sigma_mps: float | None = None
    silent: bool = False
    reset_next: bool = False
    _rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))
    _stop: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Thread body."""
        exposure = time.monotonic()
        while not self._stop.is_set():
            exposure += 1.0 / self.rate_hz
            time.sleep(max(0.0, exposure + self.latency_s - time.monotonic()))
            truth = self.pilot.truth_at(int(exposure * 1e9))
            if truth is not None and not self.silent:
                self.bridge.submit(self.fix(truth))

    def fix(self, truth: Any) -> VisionFix:
        """What a localizer would make of the truth."""
        scale = METRES_PER_DEGREE * math.cos(math.radians(HOME.latitude_deg))
        north = (truth.latitude_deg - HOME.latitude_deg) * METRES_PER_DEGREE
        east = (truth.longitude_deg - HOME.longitude_deg) * scale
        turn = math.radians(self.rotation_deg)
        noise = self._rng.normal(0.0, self.sigma_m, 3)
        n = math.cos(turn) * north - math.sin(turn) * east + noise[0] + self.jump_north_m
        e = math.sin(turn) * north + math.cos(turn) * east + noise[1]
        roll, pitch, yaw = truth.roll_pitch_yaw
        reset, self.reset_next = self.reset_next, False
        velocity = None
        if self.velocity_sigma_mps is not None:
            measured = truth.velocity_ned + self._rng.normal(0.0, self.velocity_sigma_mps, 3)
            velocity = (float(measured[0]), float(measured[1]), float(measured[2]))
        return VisionFix(
            truth.time_ns,
            HOME.latitude_deg + n / METRES_PER_DEGREE,
            HOME.longitude_deg + e / scale,
            truth.altitude_m + GEOID + noise[2],
            roll,
            pitch,
            yaw + turn,
            np.eye(3) * self.sigma_m**2,
            reset=reset,
            velocity_ned=velocity,
            velocity_sigma_mps=self.velocity_sigma_mps or 0.3,
        )

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()


@dataclass
class Flight:
    """A vehicle in the air on vision alone."""

    pilot: Pilot
    bridge: Bridge
    feed: Feed

    def corner(self, north: float, east: float) -> None:
        """Fly to a point by the EKF's own opinion."""
        where = HOME.offset(north, east, 0.0)
        self.pilot.fly_to(where.latitude_deg, where.longitude_deg, HEIGHT)

    def square(self) -> None:
        """Once around."""
        for north, east in ((SIDE, 0.0), (SIDE, SIDE), (0.0, SIDE), (0.0, 0.0)):
            self.corner(north, east)

    def errors(self, since_ns: int) -> np.ndarray:
        """Horizontal EKF errors (N,) in metres since a time."""
        return np.linalg.norm(self.pilot.ekf_errors(since_ns)[:, :2], axis=1)


def report(name: str, errors: np.ndarray) -> tuple[float, float, float]:
    """Median, p95 and max, printed for the table."""
    figures = (float(np.median(errors)), float(np.percentile(errors, 95)), float(errors.max()))
    print(f"EKF error {name}: {figures[0]:.2f} / {figures[1]:.2f} / {figures[2]:.2f} m")
    return figures


@pytest.fixture
def fly() -> Iterator[Callable[..., Flight]]:
    """Starts a vehicle, a bridge and a feed, arms and climbs; everything ends with the test."""
    ends: list[Callable[[], Any]] = []

    def start(
        parameters: dict[str, float],
        injection: InjectionConfig,
        *,
        gps: bool = False,
        switch: SourceSwitchConfig | None = None,
        **feed_options: Any,
    ) -> Flight:
        receiver = {} if gps else GPS_OFF
        vehicle = ArduPilotSitl(HOME, parameters={**parameters, **SPEEDS, **receiver})
        vehicle.start()
        ends.append(vehicle.stop)
        pilot = Pilot(vehicle.gcs_endpoint, alive=vehicle.check)
        pilot.connect()
        ends.append(pilot.close)
        config = BridgeConfig(
            connection=vehicle.companion_endpoint,
            mode="inject",
            origin=None if gps else ORIGIN,
            injection=injection,
            switch=switch or SourceSwitchConfig(),
        )
        bridge = Bridge(config, GEOID)
        bridge.start()
        ends.append(bridge.stop)
        feed = Feed(pilot, bridge, **feed_options)
        thread = threading.Thread(target=feed.run, daemon=True)
        thread.start()
        ends.append(lambda: (feed.stop(), thread.join()))
        pilot.wait_ready()
        pilot.arm()
        pilot.takeoff(HEIGHT)
        return Flight(pilot, bridge, feed)

    yield start
    for end in reversed(ends):
        end()


def test_vision_position_estimate(fly: Callable[..., Flight]) -> None:
    flight = fly(vision_only_parameters(), InjectionConfig(rate_hz=10, delay_ms=100))
    pilot, feed = flight.pilot, flight.feed
    began = time.monotonic_ns()
    flight.square()
    median, p95, _ = report("VISION_POSITION_ESTIMATE", flight.errors(began))
    assert median <= 0.23 * 1.25
    assert p95 <= 0.50 * 1.25

    # 5 s without fixes: propagated for a while, then silent; ArduPilot recovers by itself.
    began = time.monotonic_ns()
    feed.silent = True
    flight.pilot.sleep(5.0)
    feed.silent = False
    flight.pilot.sleep(5.0)
    assert report("5 s dropout", flight.errors(began))[2] < 2.0
    assert pilot.mode == "GUIDED"

    # A 10 m jump of the localizer, told: the EKF jumps cleanly with it.
    feed.jump_north_m, feed.reset_next = 10.0, True
    began = time.monotonic_ns()
    flight.pilot.sleep(2.0)
    ahead = flight.pilot.ekf_errors(began + 500_000_000)[:, 0]
    assert np.median(ahead) == pytest.approx(10.0, abs=1.0)
    assert ahead.max() < 12.0
    feed.jump_north_m, feed.reset_next = 0.0, True
    flight.pilot.sleep(2.0)

    # A vision frame rotated by 5 deg raises no warning in ArduPilot; the bridge refuses it.
    flight.corner(SIDE, 0.0)
    sent = int(flight.bridge.counters()["bridge_injected"])
    feed.rotation_deg = 5.0

    flight.pilot.sleep(4.0)

    assert int(flight.bridge.counters()["bridge_injected"]) - sent < 30
    assert any("yaw differs" in text for text in flight.bridge.texts())
    feed.rotation_deg = 0.0
    flight.pilot.sleep(4.0)
    assert report("after the refused frame", flight.errors(time.monotonic_ns() - 10**9))[0] < 1.5
    assert pilot.mode == "GUIDED"
    counters = flight.bridge.counters()
    assert counters["fc_handler_errors"] == 0
    assert counters["fc_bad_checksums"] == 0


@pytest.mark.long
def test_latency_of_250_ms_is_compensated(fly: Callable[..., Flight]) -> None:
    flight = fly(
        vision_only_parameters(delay_ms=250.0),
        InjectionConfig(rate_hz=10, delay_ms=250),
        latency_s=0.22,
        sigma_m=0.3,
    )
    began = time.monotonic_ns()
    flight.square()
    median, p95, _ = report("latency 250 ms compensated", flight.errors(began))
    assert median <= 0.27 * 1.25
    assert p95 <= 0.49 * 1.25


ODOMETRY = {"EK3_SRC1_VELXY": 6, "EK3_SRC1_VELZ": 6}


@pytest.mark.long
def test_odometry_with_measured_velocity(fly: Callable[..., Flight]) -> None:
    flight = fly(
        vision_only_parameters() | ODOMETRY,
        InjectionConfig(message="odometry", rate_hz=10, delay_ms=100),
        velocity_sigma_mps=0.1,
    )
    began = time.monotonic_ns()
    flight.square()
    median, p95, _ = report("ODOMETRY, velocity measured", flight.errors(began))
    assert median <= 0.12 * 1.25
    assert p95 <= 0.25 * 1.25


@pytest.mark.long
def test_odometry_with_derived_velocity(fly: Callable[..., Flight]) -> None:
    # Velocity from positions is worse than VISO_VEL_M_NSE's default of 0.1 m/s claims.
    flight = fly(
        vision_only_parameters(sigma_m=0.2) | ODOMETRY | {"VISO_VEL_M_NSE": 0.5},
        InjectionConfig(message="odometry", rate_hz=10, delay_ms=100),
        sigma_m=0.2,
    )
    began = time.monotonic_ns()
    flight.square()
    median, p95, _ = report("ODOMETRY, velocity derived", flight.errors(began))
    assert median <= 0.3
    assert p95 <= 0.8


@pytest.mark.long
def test_gps_input(fly: Callable[..., Flight]) -> None:
    flight = fly(
        gps_input_only_parameters(),
        InjectionConfig(message="gps_input", rate_hz=10, delay_ms=100, gps_velocity=False),
    )
    began = time.monotonic_ns()
    flight.square()
    median, p95, _ = report("GPS_INPUT without velocity", flight.errors(began))
    assert median <= 0.34 * 1.25
    assert p95 <= 0.71 * 1.25


@pytest.mark.long
def test_gnss_loss_switches_the_source_set(fly: Callable[..., Flight]) -> None:
    flight = fly(
        vision_parameters(),
        InjectionConfig(rate_hz=10, delay_ms=100),
        gps=True,
        switch=SourceSwitchConfig(enabled=True),
        sigma_m=0.3,
    )
    assert flight.bridge.shadow_score().go, flight.bridge.shadow_score().line()
    assert flight.bridge.counters()["ekf_source_set"] == 1
    hover = flight.pilot.truth
    flight.pilot.gps(on=False)
    flight.pilot.sleep(15.0)
    assert flight.bridge.counters()["ekf_source_set"] == 2, flight.bridge.state()
    assert any("EKF source set 2: GNSS" in text for text in flight.bridge.texts())
    assert flight.pilot.mode == "GUIDED"
    moved = flight.pilot.truth.location.ned_of(hover.location)
    assert math.hypot(moved[0], moved[1]) < 1.2 * 1.25
    assert flight.bridge.counters()["bridge_source_switches"] == 1


def test_doctor_finds_and_fixes_what_is_wrong() -> None:
    wrong = {
        "GPS1_TYPE": 0,
        "VISO_TYPE": 1,
        "EK3_SRC1_POSXY": 6,
        "EK3_SRC1_VELXY": 3,
        "EK3_SRC1_VELZ": 3,
        "EK3_SRC1_POSZ": 1,
        "EK3_SRC1_YAW": 1,
        "VISO_DELAY_MS": 10,
        "VISO_QUAL_MIN": 40,
    }
    with ArduPilotSitl(HOME, parameters={**wrong, **GIMBAL}) as vehicle:
        config = BridgeConfig(connection=vehicle.companion_endpoint, origin=ORIGIN)
        before = examine(config)
        assert before.exit_code == 2
        bad = {f.name for f in before.findings if not f.ok}
        assert bad == {"EK3_SRC1_VELXY", "EK3_SRC1_VELZ", "VISO_DELAY_MS", "VISO_QUAL_MIN"}
        repair(config, before.fixable)
        after = examine(config)
        assert after.exit_code == 0, [f for f in after.findings if not f.ok]
