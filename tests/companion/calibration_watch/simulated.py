"""A flight with turns and a climb, its sensors and a localizer with a wrong calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from companion.calibration_watch.observation import CalibrationObservation
from companion.calibration_watch.watch import CalibrationFigures, CalibrationWatch
from companion.geometry import GIMBAL_FROM_CAMERA
from companion.inertial import InertialTrack
from localizer.geometry.pose import matrix_from_euler, so3_exp
from localizer.sensors.error_model import GRAVITY_MPS2
from mavlink_bridge import quaternion as quat
from mavlink_bridge.messages import Attitude, GimbalAttitude, InertialSample, VehicleState
from mavlink_bridge.vehicle.origin import offset

Array = NDArray[np.float64]
LATITUDE, LONGITUDE, GROUND = 47.4, 8.5, 480.0
IMU_HZ, STEP_HZ = 26, 2
SPEED, ACCELERATION, TURN_RADPS = 8.0, 2.5, np.radians(45.0)


@dataclass(frozen=True)
class Route:
    """positions (n, 3) north, east, up from the ground; yaw (n,), unwrapped; at IMU_HZ."""

    positions: Array
    yaw: Array


@lru_cache
def square(seconds: float, leg_s: float = 15.0, climb_s: float = 16.0, hold: bool = False) -> Route:
    """A climb from 20 m to 60 m, then a square at 8 m/s, the nose along the course; hold: hovers
    instead, at 60 m.
    """
    n = round(seconds * IMU_HZ) + 1
    dt = 1.0 / IMU_HZ
    p, v, yaw = np.array([0.0, 0.0, 20.0 if climb_s else 60.0]), np.zeros(3), 0.0
    rows, yaws = [], []
    for k in range(n):
        t = k * dt
        side = int(max(t - climb_s, 0.0) // leg_s)
        course = np.pi / 2 * side
        wanted = np.array([np.cos(course), np.sin(course), 0.0]) * SPEED
        if t < climb_s:
            wanted = np.array([0.0, 0.0, 2.5])
        if hold:
            wanted = np.zeros(3)
        change = wanted - v
        most = ACCELERATION * dt
        v = v + change * min(1.0, most / max(float(np.linalg.norm(change)), 1e-9))
        p = p + v * dt
        yaw += float(np.clip(course - yaw, -TURN_RADPS * dt, TURN_RADPS * dt))
        rows.append(p)
        yaws.append(yaw)
    return Route(np.array(rows), np.array(yaws))


@dataclass(frozen=True)
class Wrong:
    """What is wrong. focal: share, from `zoom_s` on reached within `zooms_for_s`; boresight_deg:
    yaw, pitch; late_s from `late_from_s` on; the sensors' honest errors: barometer's scale, GNSS
    bias (m), compass (deg), map shift (m), tilt.
    """

    focal: float = 0.0
    zoom_s: float = 0.0
    zooms_for_s: float = 0.0
    boresight_deg: tuple[float, float] = (0.0, 0.0)
    late_s: float = 0.0
    late_from_s: float = 0.0
    pressure_scale: float = 0.0
    gnss_m: tuple[float, float] = (0.0, 0.0)
    compass_deg: float = 0.0
    map_m: tuple[float, float] = (0.0, 0.0)
    tilt_deg: float = 0.0


@dataclass
class Flown:
    """Flies the route and steps the watch; `found` keeps the figures of each step."""

    wrong: Wrong = field(default_factory=Wrong)
    route: Route = field(default_factory=lambda: square(90.0))
    gnss: Callable[[float], bool] = lambda at_s: True
    pitch_deg: float = -45.0
    seed: int = 1

    def __post_init__(self) -> None:
        self.watch, self.track = CalibrationWatch(), InertialTrack()
        self.found: list[tuple[float, CalibrationFigures]] = []
        self._rng = np.random.default_rng(self.seed)
        self._at_s = 0.0
        self._slow = np.zeros(3)
        self._wander = np.zeros(3)

    def fly(self) -> Flown:
        """The whole route."""
        positions = self.route.positions
        accelerations = np.gradient(np.gradient(positions, axis=0), axis=0) * IMU_HZ**2
        rates = np.gradient(self.route.yaw) * IMU_HZ
        for k in range(1, len(positions)):
            self._at_s = k / IMU_HZ
            self.track.add(self._sample(k, accelerations[k], float(rates[k])), self.attitude_at)
            if k % (IMU_HZ // STEP_HZ) == 0:
                self._errors()
                self.watch.add(self._sighting(self._at_s))
                self.watch.step(round(self._at_s * 1e9), self, self.track)
                self.found.append((self._at_s, self.watch.figures()))
        return self

    def first(self, is_found: Callable[[CalibrationFigures], bool]) -> float:
        """Seconds until it was first found; infinite if never."""
        return next((at_s for at_s, figures in self.found if is_found(figures)), np.inf)

    # --- what the vehicle says ------------------------------------------------------------------

    def state(self) -> VehicleState:
        """Now."""
        now_ns = round(self._at_s * 1e9)
        north, east, up = self._where(self._at_s) + self._wander
        place = offset(LATITUDE, LONGITUDE, north, east)
        pressure = self._where(self._at_s)[2] * (1.0 + self.wrong.pressure_scale)
        healthy = self.gnss(self._at_s)
        velocity = self._velocity(self._at_s)
        return VehicleState(
            connected=True,
            armed=True,
            latitude_deg=place[0],
            longitude_deg=place[1],
            local_velocity_ned=(float(velocity[0]), float(velocity[1]), -float(velocity[2])),
            gps_fix_type=3 if healthy else 1,
            gps_latitude_deg=place[0],
            gps_longitude_deg=place[1],
            gps_altitude_amsl_m=GROUND - 47.0 + up,
            gps_time_ns=now_ns,
            pressure_altitude_m=300.0 + pressure + 0.1 * self._rng.standard_normal(),
            pressure_time_ns=now_ns,
        )

    def gnss_place_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF on GNSS."""
        if not self.gnss(self._at_s):
            return None
        where = self._where(time_ns * 1e-9) + self._wander
        return (*offset(LATITUDE, LONGITUDE, where[0], where[1]), GROUND - 47.0 + where[2])

    def attitude_at(self, time_ns: int) -> Attitude:
        """Level but for the tilt error, and the compass's."""
        yaw = self._yaw(time_ns * 1e-9) + np.radians(self.wrong.compass_deg)
        tilt = float(np.radians(self.wrong.tilt_deg))
        return Attitude(time_ns, 0.0, tilt, yaw, quat.from_euler(0.0, tilt, yaw))

    def gimbal_at(self, time_ns: int) -> GimbalAttitude:
        """As reported, on the reported heading."""
        yaw = self._yaw(time_ns * 1e-9) + np.radians(self.wrong.compass_deg)
        pitch = np.radians(self.pitch_deg)
        q = quat.from_euler(0.0, float(pitch), float(yaw))
        return GimbalAttitude(time_ns, 0.0, float(pitch), float(yaw), q, "test")

    # --- what is true ---------------------------------------------------------------------------

    def _where(self, at_s: float) -> Array:
        return np.array([np.interp(at_s * IMU_HZ, self._ticks, c) for c in self.route.positions.T])

    def _velocity(self, at_s: float) -> Array:
        return (self._where(at_s + 0.02) - self._where(at_s - 0.02)) / 0.04

    def _yaw(self, at_s: float) -> float:
        return float(np.interp(at_s * IMU_HZ, self._ticks, self.route.yaw))

    @cached_property
    def _ticks(self) -> Array:
        return np.arange(len(self.route.yaw), dtype=float)

    def _sample(self, k: int, acceleration: Array, rate: float) -> InertialSample:
        """Of the true, level body; the autopilot's tilt is what is wrong."""
        noise = self._rng.standard_normal(6)
        yaw = float(self.route.yaw[k])
        ned = np.array([acceleration[0], acceleration[1], -acceleration[2] - GRAVITY_MPS2])
        north, east, down = matrix_from_euler(0.0, 0.0, yaw).T @ ned + 0.1 * noise[:3]
        rates = (0.003 * noise[3], 0.003 * noise[4], rate + 0.003 * noise[5])
        return InertialSample(round(self._at_s * 1e9), (north, east, down), rates)

    # --- what vision says -----------------------------------------------------------------------

    def _errors(self) -> None:
        """Vision's errors last two seconds, GNSS's a minute."""
        h = 1.0 / STEP_HZ
        noise = self._rng.standard_normal(6)
        self._slow = self._slow * np.exp(-h / 2.0) + 0.1 * np.sqrt(h) * noise[:3]
        self._wander = self._wander + np.array([0.1, 0.1, 0.2]) * np.sqrt(h) * noise[3:]

    def _sighting(self, at_s: float) -> CalibrationObservation:
        wrong = self.wrong
        seen_s = at_s - (wrong.late_s if at_s >= wrong.late_from_s else 0.0)
        where, yaw = self._where(seen_s), self._yaw(seen_s)
        camera = matrix_from_euler(0.0, np.radians(self.pitch_deg), yaw) @ GIMBAL_FROM_CAMERA
        axis = camera[:, 2]
        depth = where[2] / max(float(axis[2]), 0.1)
        noise = self._slow + 0.05 * self._rng.standard_normal(3)
        grown = (at_s - wrong.zoom_s) / max(wrong.zooms_for_s, 1e-6)
        focal = wrong.focal * min(max(grown, 0.0), 1.0) if wrong.zoom_s else wrong.focal
        north, east, down = -focal * depth * axis
        place = offset(
            LATITUDE,
            LONGITUDE,
            where[0] + north + noise[0] + wrong.map_m[0] - wrong.gnss_m[0],
            where[1] + east + noise[1] + wrong.map_m[1] - wrong.gnss_m[1],
        )
        off = np.radians([0.0, wrong.boresight_deg[1], wrong.boresight_deg[0]])
        right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        turned = so3_exp(right * off[1]) @ so3_exp(np.array([0.0, 0.0, off[2]])) @ camera
        turned = so3_exp(0.003 * self._rng.standard_normal(3)) @ turned
        return CalibrationObservation(
            round(at_s * 1e9),
            (*place, GROUND + where[2] - down + noise[2]),
            0.1,
            turned,
            depth * (1.0 + focal),
            60.0,
        )
