"""The whole vehicle: simulation, estimator, modes and MAVLink, in one thread and simulated time."""

from __future__ import annotations

import time
from math import cos, exp, radians, sin, sqrt

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded import dynamics
from sitl.embedded.arming import ArmingContext, arming_failures
from sitl.embedded.commands import Commands
from sitl.embedded.estimator import (
    CRITICAL,
    Baro,
    Compass,
    Estimator,
    GpsData,
)
from sitl.embedded.geodesy import Location
from sitl.embedded.gimbal import Gimbal
from sitl.embedded.injection import Injection
from sitl.embedded.loop import TICK_S, advance
from sitl.embedded.mavlink_server import MavlinkServer
from sitl.embedded.mission import MissionStore
from sitl.embedded.modes import FlightModes
from sitl.embedded.parameters import Parameters
from sitl.embedded.rotation import Array, euler
from sitl.embedded.sensors import GpsSample, Sensors
from sitl.embedded.telemetry import DEFAULT_STREAMS, Telemetry

_GPS_FIX_AFTER_S = 30.0  # a cold start; with the filter's 10 s of checks ArduPilot's 42 s
_GPS_SIMULATED = (1, 2)  # GPS1_TYPE auto and u-blox read the simulated receiver
_MAX_LAG_S = 0.25  # of wall time behind schedule after which the schedule starts anew
_GUST_CORRELATION_S = 3.0


class Vehicle:
    """A quadrotor at `home` (AMSL), heading `heading_deg`, with the autopilot around it."""

    def __init__(
        self,
        home: Location,
        heading_deg: float,
        parameters: Parameters,
        server: MavlinkServer,
        seed: int = 0,
    ) -> None:
        self.launch = home
        self.parameters = parameters
        self.server = server
        self.tick = 0
        self.reboot_ordered = False
        self.truth = dynamics.initial_state(radians(heading_deg))
        self.sensors = Sensors(seed)
        self._rng = np.random.default_rng([seed, 1])
        self._gust = np.zeros(3)
        self.estimator = Estimator(parameters, self.notify)
        self.gimbal = Gimbal(parameters)
        self.mission = MissionStore()
        self.modes = FlightModes(
            parameters, self.estimator, self.gimbal, self.mission, self.notify, self._reached
        )
        self.injection = Injection(parameters, self.estimator)
        self.telemetry = Telemetry(self)
        self.commands = Commands(self)
        self.gps_sample: GpsSample | None = None
        self._gps_sample_at = -1e9
        self._integrator = np.zeros(3)
        self._increment = np.zeros(7)
        self._announced = (False, False)
        for link in server.links:
            for message_id, hertz in DEFAULT_STREAMS.items():
                link.set_interval(message_id, 1.0 / hertz)

    # --- clock -------------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Simulated seconds since boot."""
        return self.tick * TICK_S

    @property
    def time_ms(self) -> int:
        """Simulated milliseconds since boot."""
        return round(self.tick * TICK_S * 1000)

    def run(self) -> None:
        """Run at SIM_SPEEDUP times real time until a reboot is ordered."""
        schedule = time.monotonic()
        while not self.reboot_ordered:
            self.step()
            schedule += TICK_S / max(self.parameters["SIM_SPEEDUP"], 0.1)
            now = time.monotonic()
            if schedule > now:
                time.sleep(schedule - now)
            elif now - schedule > _MAX_LAG_S:
                schedule = now  # too slow a machine: simulated time falls behind, it never jumps

    def step(self) -> None:
        """One 10 ms tick: inputs, sensors, estimator, control, physics, outputs."""
        simulated = self.parameters["GPS1_TYPE"] in _GPS_SIMULATED
        self.injection.receiver_has_fix = simulated and self.gps_has_fix
        for link, message in self.server.poll():
            self.commands.handle(link, message)
        self.tick += 1
        target = self.modes.update(self.time_s)
        advance(
            self.truth,
            self.estimator.output,
            target,
            self._integrator,
            self._wind(),
            self.sensors.imu_bias,
            self.sensors.imu_noise(),
            self._increment,
            self.modes.armed,
        )
        self.modes.on_ground = bool(self.truth[2] >= 0.0)
        self._sense()
        self.estimator.update(self._increment, self.time_ms)
        vehicle_yaw = euler(self.estimator.output[0:4])[2]
        self.gimbal.update(self.estimator.location, vehicle_yaw, TICK_S)
        if self.tick % 10 == 0:
            self.modes.check_ekf()
            self.modes.check_glitch()
        if self.tick % 3000 == 0 and not self.modes.armed:
            self.report_failures("PreArm")
        self._announce()
        self.telemetry.stream()
        self.server.flush()

    def _announce(self) -> None:
        """What ArduPilot sends unasked: origin and home when they are set, TIMESYNC every 10 s."""
        if self.tick % 1000 == 0:
            self.server.broadcast(mavlink.MAVLink_timesync_message(0, self.time_ms * 1_000_000))
        known = (self.estimator.origin is not None, self.modes.home is not None)
        if known != self._announced:
            self._announced = known
            for message_id in (
                mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
                mavlink.MAVLINK_MSG_ID_HOME_POSITION,
            ):
                message = self.telemetry.message(message_id)
                if message is not None:
                    self.server.broadcast(message)

    # --- physics and sensors -----------------------------------------------------------------

    def _wind(self) -> Array:
        """Mean wind (from SIM_WIND_DIR) weakened near the ground, plus first-order gusts."""
        p = self.parameters
        keep = exp(-TICK_S / _GUST_CORRELATION_S)
        self._gust *= keep
        self._gust += p["SIM_WIND_TURB"] * sqrt(1 - keep**2) * self._rng.standard_normal(3)
        height = max(-float(self.truth[2]), 0.0)
        profile = min(1.0, sqrt(height / 60.0))  # ArduPilot's square law up to 60 m
        speed, source = p["SIM_WIND_SPD"], radians(p["SIM_WIND_DIR"])
        mean = np.array([-speed * cos(source), -speed * sin(source), 0.0])
        return (mean + self._gust * np.array([1.0, 1.0, 0.4])) * profile

    def _sense(self) -> None:
        now = self.time_ms
        if self.tick == 1:
            self.estimator.align(self.sensors.compass(self.truth))
        if self.tick % 10 == 0:
            self.estimator.add(Baro(self.sensors.barometer(self.truth, 0.1)), now)
        if self.tick % 10 == 5:
            self.estimator.add(Compass(self.sensors.compass(self.truth)), now)
        p = self.parameters
        powered = p["SIM_GPS1_ENABLE"] > 0 and p["GPS1_TYPE"] in _GPS_SIMULATED
        sample = self.sensors.gps(self.time_s, self.truth, p["SIM_GPS1_JAM"] > 0, self._glitch())
        started = self.time_s >= _GPS_FIX_AFTER_S
        if powered and started and sample is not None and sample.fix:
            self.gps_sample, self._gps_sample_at = sample, self.time_s
            where = self.launch.offset(*(float(c) for c in sample.position))
            n, e, d = (float(c) for c in sample.velocity)
            self.estimator.add(
                GpsData(
                    where.latitude_deg,
                    where.longitude_deg,
                    where.altitude_m,
                    (n, e),
                    d,
                    sample.horizontal_accuracy,
                    sample.speed_accuracy,
                    sample.satellites,
                    hdop=1.2,
                ),
                round(sample.time_s * 1000),
            )

    def _glitch(self) -> Array:
        """NED metres by which the receiver is wrong; SIM_GPS1_GLTCH_X and _Y are degrees."""
        p, here = self.parameters, self.launch
        wrong = Location(
            here.latitude_deg + p["SIM_GPS1_GLTCH_X"],
            here.longitude_deg + p["SIM_GPS1_GLTCH_Y"],
            here.altitude_m,
        )
        return np.array(here.ned_of(wrong))

    @property
    def true_location(self) -> Location:
        """Where the vehicle really is."""
        return self.launch.offset(*(float(c) for c in self.truth[0:3]))

    @property
    def gps_has_fix(self) -> bool:
        """Whether the receiver (simulated, or GPS_INPUT) has a 3D fix."""
        kind = self.parameters["GPS1_TYPE"]
        if kind in _GPS_SIMULATED:
            return self.time_s - self._gps_sample_at < 1.0
        return self.injection.gps_fix(self.time_ms)

    @property
    def gps_healthy(self) -> bool:
        """Whether fixes come at 5 Hz or nearly so."""
        if self.parameters["GPS1_TYPE"] in _GPS_SIMULATED:
            return self.gps_has_fix
        return self.injection.gps_healthy(self.time_ms)

    # --- autopilot ---------------------------------------------------------------------------

    def notify(self, severity: int, text: str) -> None:
        """STATUSTEXT on every link."""
        self.server.broadcast(mavlink.MAVLink_statustext_message(severity, text.encode()[:50]))

    def arming_failures(self) -> list[str]:
        """Texts of the failing arming checks."""
        return arming_failures(
            ArmingContext(
                self.time_s,
                self.parameters,
                self.estimator,
                self.modes.mode.name,
                self.modes.mode.armable,
                self.modes.mode.needs_position,
                self.modes.home is not None,
                self.gps_has_fix,
                self.gps_healthy,
                self.injection.healthy(self.time_ms),
            )
        )

    def report_failures(self, prefix: str) -> bool:
        """Send each failing check as a STATUSTEXT; True when there are any."""
        failures = self.arming_failures()
        for text in failures:
            self.notify(CRITICAL, f"{prefix}: {text}")
        return bool(failures)

    def _reached(self, index: int) -> None:
        self.server.broadcast(mavlink.MAVLink_mission_item_reached_message(index))
