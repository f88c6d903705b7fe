"""The simulated aircraft: physics, sensors, autopilot and its arming checks, in simulated time."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, exp, radians, sin, sqrt

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.control.controller import advance
from sitl.embedded.control.mission import MissionStore
from sitl.embedded.control.modes import FlightModes
from sitl.embedded.control.px4_modes import Px4Modes
from sitl.embedded.ekf.aided_filter import EXTERNAL, GPS
from sitl.embedded.ekf.ekf2_injection import Px4PositionInput
from sitl.embedded.ekf.estimator import Estimator
from sitl.embedded.ekf.injection import ExternalNavInput
from sitl.embedded.ekf.measurements import Baro, Compass, GpsData
from sitl.embedded.mavlink.server import MavlinkServer
from sitl.embedded.parameters import Parameters
from sitl.embedded.physics import dynamics
from sitl.embedded.physics.dynamics import TICK_S
from sitl.embedded.physics.gimbal import Gimbal
from sitl.embedded.physics.rotation import Array, euler
from sitl.embedded.physics.sensors import GpsSample, Sensors
from sitl.embedded.severity import CRITICAL, INFO
from sitl.geodesy import Location

_ALL, _GPS_CHECK, _INS, _VISION = 1, 1 << 3, 1 << 4, 1 << 18  # ARMING_CHECK
GYRO_SETTLE_S = 25.0  # as measured on ArduPilot SITL


@dataclass(frozen=True)
class ArmingContext:
    """Vehicle state that the pre-arm checks use."""

    time_s: float
    parameters: Parameters
    estimator: Estimator
    mode_name: str
    mode_armable: bool
    needs_position: bool
    home_set: bool
    gps_fix: bool
    gps_healthy: bool
    vision_healthy: bool


def arming_failures(context: ArmingContext) -> list[str]:
    """The texts of all arming checks that fail, as ArduPilot words them; an empty list if the
    vehicle may arm.
    """
    failures = _optional(context) + _mandatory(context)
    if not context.mode_armable:
        failures.append(f"{context.mode_name} mode not armable")
    return failures


def _optional(c: ArmingContext) -> list[str]:
    failures = []
    if _enabled(c, _INS) and c.time_s < GYRO_SETTLE_S:
        failures.append("Gyros inconsistent")
    if _enabled(c, _GPS_CHECK):
        if c.parameters["GPS1_TYPE"] > 0 and not c.gps_fix:
            failures.append("GPS 1: Bad fix")
        elif c.parameters["GPS1_TYPE"] > 0 and not c.gps_healthy:
            failures.append("GPS 1: not healthy")
        elif not c.home_set:
            failures.append("AHRS: waiting for home")
    if _enabled(c, _VISION) and c.parameters["VISO_TYPE"] > 0 and not c.vision_healthy:
        failures.append("VisOdom: not healthy")
    return failures


def _enabled(c: ArmingContext, check: int) -> bool:
    return bool(int(c.parameters["ARMING_CHECK"]) & (_ALL | check))


def _mandatory(c: ArmingContext) -> list[str]:
    sources = _source_failure(c)
    if sources:
        return [f"AHRS: {sources}"]
    if not c.needs_position:
        return []
    if not c.estimator.position_valid:
        return ["Need Position Estimate"]
    if c.estimator.gps_glitching:
        return ["GPS glitching"]
    limit = c.parameters["FS_EKF_THRESH"]
    velocity, position, height, compass = c.estimator.variances
    named = (
        ("compass", compass),
        ("position", position),
        ("velocity", velocity),
        ("height", height),
    )
    return [f"EKF {name} variance" for name, value in named if 0 < limit <= value][:1]


def _source_failure(c: ArmingContext) -> str | None:
    """EKF3's check that every configured source has its sensor."""
    position = [
        int(c.parameters[f"EK3_SRC{n}_{what}"])
        for n in (1, 2, 3)
        for what in ("POSXY", "VELXY", "POSZ", "VELZ")
        if c.needs_position
    ]
    yaw = [int(c.parameters[f"EK3_SRC{n}_YAW"]) for n in (1, 2, 3)]
    if GPS in position and c.parameters["GPS1_TYPE"] == 0:
        return "EK3 sources require GPS"
    if EXTERNAL in position + yaw and c.parameters["VISO_TYPE"] == 0:
        return "EK3 sources require VisualOdom"
    return None


_GPS_FIX_AFTER_S = 30.0  # a cold start; with the filter's 10 s of checks ArduPilot's 42 s
_GPS_LAG_S = 0.1  # what the filter takes it for
GPS_SIMULATED = (1, 2)  # GPS1_TYPE auto and u-blox read the simulated receiver
_GUST_CORRELATION_S = 3.0


class Aircraft:
    """A quadrotor with its autopilot. home: start position, altitude AMSL. heading_deg: from true
    north. seed: of sensor noise and gusts.

    Above 200 lines: commands and telemetry read all of it, as ArduPilot's do of `copter`.
    """

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
        px4 = parameters.is_px4
        self.modes = (Px4Modes if px4 else FlightModes)(
            parameters, self.estimator, self.gimbal, self.mission, self.notify, self._reached
        )
        taken = Px4PositionInput if px4 else ExternalNavInput
        self.injection: ExternalNavInput = taken(parameters, self.estimator)
        self.gps_sample: GpsSample | None = None
        self._gps_sample_at = -1e9
        self.barometer_m = 0.0
        self._integrator = np.zeros(3)
        self._increment = np.zeros(7)

    # --- clock -------------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Simulated seconds since boot."""
        return self.tick * TICK_S

    @property
    def time_ms(self) -> int:
        """Simulated milliseconds since boot."""
        return round(self.tick * TICK_S * 1000)

    @property
    def angular_rate(self) -> Array:
        """Gyro measurement, rad/s (3,), body axes: mean of the last tick, with bias."""
        return self._increment[0:3] / TICK_S

    @property
    def specific_force(self) -> Array:
        """Accelerometer measurement, m/s² (3,), body axes: mean of the last tick."""
        return self._increment[3:6] / TICK_S

    # --- a tick ------------------------------------------------------------------------------

    def begin_tick(self) -> None:
        """Update what the tick's commands read: whether the simulated receiver has a fix."""
        simulated = self.parameters["GPS1_TYPE"] in GPS_SIMULATED
        self.injection.receiver_has_fix = simulated and self.gps_has_fix

    def step(self) -> None:
        """Advance by 10 ms: control, physics, sensors, estimator, gimbal."""
        self.tick += 1
        target = self.modes.update(self.time_s)
        advance(
            self.truth,
            self.estimator.output,
            target,
            self._integrator,
            self.wind(),
            self.sensors.imu_bias,
            self.sensors.imu_noise(),
            self._increment,
            self.modes.armed,
        )
        self.modes.on_ground = bool(self.truth[2] >= 0.0)
        self.sense()
        self.estimator.update(self._increment, self.time_ms)
        vehicle_yaw = euler(self.estimator.output[0:4])[2]
        self.gimbal.update(self.estimator.location, vehicle_yaw, TICK_S)
        if self.tick % 10 == 0:
            self.modes.check_ekf()
        if self.tick % 3000 == 0 and not self.modes.armed:
            self.report_failures("PreArm")

    # --- physics and sensors -----------------------------------------------------------------

    def wind(self) -> Array:
        """Wind (3,) NED m/s of the next tick, whose gusts each call advances: mean (SIM_WIND_*),
        weaker near the ground, plus first-order gusts.
        """
        p = self.parameters
        keep = exp(-TICK_S / _GUST_CORRELATION_S)
        self._gust *= keep
        self._gust += p["SIM_WIND_TURB"] * sqrt(1 - keep**2) * self._rng.standard_normal(3)
        height = max(-float(self.truth[2]), 0.0)
        profile = min(1.0, sqrt(height / 60.0))  # ArduPilot's square law up to 60 m
        speed, source = p["SIM_WIND_SPD"], radians(p["SIM_WIND_DIR"])
        mean = np.array([-speed * cos(source), -speed * sin(source), 0.0])
        wind: Array = (mean + self._gust * np.array([1.0, 1.0, 0.4])) * profile
        return wind

    def sense(self) -> None:
        """Read the sensors that are due at this tick, and pass their measurements to the EKF. The
        first tick also aligns the EKF's attitude.
        """
        now = self.time_ms
        if self.tick == 1:
            self.estimator.align(self.sensors.compass(self.truth))
        if self.tick % 10 == 0:
            self.barometer_m = self.sensors.barometer(self.truth, 0.1)
            self.estimator.add(Baro(self.barometer_m), now)
        if self.tick % 10 == 5:
            self.estimator.add(Compass(self.sensors.compass(self.truth)), now)
        p = self.parameters
        powered = p["SIM_GPS1_ENABLE"] > 0 and p["GPS1_TYPE"] in GPS_SIMULATED
        lag_s = p["SIM_GPS1_LAG_MS"] * 1e-3
        sample = self.sensors.gps(
            self.time_s,
            self.truth,
            p["SIM_GPS1_JAM"] > 0,
            self._glitch(),
            lag_s,
            p["SIM_GPS1_ACC"],
        )
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
                # The autopilot does not know of a lag that is not the receiver's usual one.
                round((sample.time_s + lag_s - _GPS_LAG_S) * 1000),
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
        """True position of the vehicle."""
        return self.launch.offset(*(float(c) for c in self.truth[0:3]))

    @property
    def gps_has_fix(self) -> bool:
        """Whether the receiver (simulated, or GPS_INPUT) has a 3D fix."""
        kind = self.parameters["GPS1_TYPE"]
        if kind in GPS_SIMULATED:
            return self.time_s - self._gps_sample_at < 1.0
        return self.injection.gps_fix(self.time_ms)

    @property
    def gps_healthy(self) -> bool:
        """Whether fixes arrive at about 5 Hz or more."""
        if self.parameters["GPS1_TYPE"] in GPS_SIMULATED:
            return self.gps_has_fix
        return self.injection.gps_healthy(self.time_ms)

    # --- autopilot ---------------------------------------------------------------------------

    def notify(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT (at most 50 bytes of `text`) on every link. severity: MAV_SEVERITY."""
        self.server.broadcast(mavlink.MAVLink_statustext_message(severity, text.encode()[:50]))

    def use_source(self, source: int) -> None:
        """Switch the EKF to a source set, 1 to 3, and report a change as STATUSTEXT."""
        if self.estimator.sources.source_set != source:
            self.estimator.sources.source_set = source
            self.notify(INFO, f"Using EKF Source Set {source}")

    def arming_failures(self) -> list[str]:
        """Texts of the failing arming checks."""
        if isinstance(self.modes, Px4Modes):
            settled = self.time_s >= GYRO_SETTLE_S and self.modes.position_ok
            return [] if settled else ["no valid global position"]
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
        """Send each failing arming check as a STATUSTEXT after `prefix`; True if there are any."""
        failures = self.arming_failures()
        for text in failures:
            self.notify(CRITICAL, f"{prefix}: {text}")
        return bool(failures)

    def _reached(self, index: int) -> None:
        self.server.broadcast(mavlink.MAVLink_mission_item_reached_message(index))
