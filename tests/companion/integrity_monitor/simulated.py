"""An aircraft, its IMU and a localizer, by the clock of the test: evidence for the monitor."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from companion.integrity_monitor.checks import IntegrityChecks, IntegrityLimits
from companion.integrity_monitor.config import IntegrityMonitorConfig
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import (
    Attitude,
    GimbalAttitude,
    InertialSample,
    VehicleState,
    VisionFix,
)
from mavlink_bridge.vehicle.origin import north_east, offset

Array = NDArray[np.float64]
Path = Callable[[float], tuple[float, float]]
IMU_HZ, FIX_HZ, STEP_HZ = 50, 10, 10
GRAVITY = 9.80665
LATITUDE, LONGITUDE, HEIGHT = 47.4, 8.5, 535.0


def second(at_s: float) -> int:
    """Nanoseconds of a time in the test."""
    return round(at_s * 1e9)


def hover(at_s: float) -> tuple[float, float]:
    """What a hover in wind sways: 0.3 m with 17 s and 0.1 m with 5 s."""
    slow, fast = 2 * np.pi * at_s / 17.0, 2 * np.pi * at_s / 5.0
    return 0.3 * np.sin(slow) + 0.1 * np.sin(fast), 0.3 * np.cos(slow) - 0.1 * np.cos(fast)


def leg(at_s: float) -> tuple[float, float]:
    """Out of a hover at 5 s with 2.5 m/s^2 to 10 m/s, northwards."""
    t = max(at_s - 5.0, 0.0)
    north, east = hover(at_s)
    return north + (1.25 * t * t if t < 4.0 else 20.0 + 10.0 * (t - 4.0)), east


def swung(at_s: float) -> tuple[float, float]:
    """To and fro by 12 m with 12 s: what shows a delay within half a minute."""
    return 6.0 * np.sin(2 * np.pi * at_s / 12.0), 0.0


def beside(path: Path, by: Path) -> Path:
    """A path moved (north, east) by the time."""

    def moved(at_s: float) -> tuple[float, float]:
        (north, east), (more_north, more_east) = path(at_s), by(at_s)
        return north + more_north, east + more_east

    return moved


def turned(path: Path, from_s: float, until_s: float, degrees: float = 5.0) -> Path:
    """What a frame shows that turns about home for a while."""
    a = np.radians(degrees)

    def seen(at_s: float) -> tuple[float, float]:
        north, east = path(at_s)
        if not from_s <= at_s < until_s:
            return north, east
        return north * np.cos(a) - east * np.sin(a), north * np.sin(a) + east * np.cos(a)

    return seen


def monitor(**limits: float) -> IntegrityChecks:
    """With the shipped limits, but for those given."""
    return IntegrityChecks(IntegrityMonitorConfig(), IntegrityLimits(**limits))


@dataclass
class Flight:
    """Flies `path` (seconds to north, east) level, and steps the monitor; a fix every 0.1 s.

    seen: the path that vision sees; GNSS: its offset (north, m), None without a receiver. moved:
    when only the position was held, by_odometry; claims: the scale sigma of each of these. silent:
    no fix comes between these seconds.
    """

    monitor: IntegrityChecks
    path: Path = hover
    seen: Path | None = None
    noise_m: float = 0.16
    claimed_m: float = 0.16
    tilt_rad: float = 0.003
    gnss_north_m: Callable[[float], float] | None = None
    gnss_accuracy_m: float = 1.0
    height_m: Callable[[float], float] = lambda at_s: 0.0
    reset_at_s: float = -1.0
    at_s: float = 0.0
    lines: list[tuple[float, Alert]] = field(default_factory=list)
    passed: list[VisionFix] = field(default_factory=list)
    held: list[float] = field(default_factory=list)
    moved: list[float] = field(default_factory=list)
    claims: list[float] = field(default_factory=list)
    seed: int = 1
    by_odometry: bool = False
    silent: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._imu: list[InertialSample] = []

    def fly(self, until_s: float) -> Flight:
        """On to a time of the flight."""
        while self.at_s < until_s:
            tick = round(self.at_s * IMU_HZ)
            self._imu = [*self._imu[-100:], self._inertial(self.at_s)]
            if tick % (IMU_HZ // FIX_HZ) == 0:
                self._offer(self._fix(self.at_s))
            if tick % (IMU_HZ // STEP_HZ) == 0:
                alerts = self.monitor.step(second(self.at_s), self)
                self.lines += [(self.at_s, alert) for alert in alerts]
            self.at_s = (tick + 1) / IMU_HZ
        return self

    def told(self, of: AlertId) -> float:
        """When an alert was raised first; infinite if never."""
        return min(self.times(of), default=np.inf)

    def ended(self, of: AlertId) -> float:
        """When an alert was cleared first; infinite if never."""
        return min(self.times(of, active=False), default=np.inf)

    def times(self, of: AlertId, *, active: bool = True) -> list[float]:
        """When an alert was reported."""
        return [at_s for at_s, one in self.lines if (one.id, one.active) == (of, active)]

    # --- the vehicle ----------------------------------------------------------------------------

    def state(self) -> VehicleState:
        """Armed, airborne, and following vision."""
        north, east = self.path(self.at_s)
        now_ns = second(self.at_s)
        state = VehicleState(
            connected=True,
            armed=True,
            altitude_relative_m=60.0,
            local_position_ned=(north, east, -60.0),
            local_velocity_ned=(*self._velocity(self.at_s), 0.0),
            local_time_ns=now_ns,
            pressure_altitude_m=500.0,
            pressure_time_ns=now_ns,
        )
        if self.gnss_north_m is None:
            return state
        there = offset(LATITUDE, LONGITUDE, north + self.gnss_north_m(self.at_s), east)
        return replace(
            state,
            gps_fix_type=3,
            gps_latitude_deg=there[0],
            gps_longitude_deg=there[1],
            gps_h_accuracy_m=self.gnss_accuracy_m,
            gps_time_ns=now_ns,
        )

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """Level but for an error that the EKF does not know of."""
        half = 0.5 * self.tilt_rad
        return Attitude(time_ns, 0.0, self.tilt_rad, 0.0, (np.cos(half), 0.0, np.sin(half), 0.0))

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """A camera that looks straight north and 45 degrees down, as it is reported."""
        half = -np.pi / 8.0
        q = (float(np.cos(half)), 0.0, float(np.sin(half)), 0.0)
        return GimbalAttitude(time_ns, 0.0, 2.0 * half, 0.0, q, "test")

    def gnss_place_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF follows vision here."""
        return None

    def inertial_since(self, time_ns: int) -> tuple[InertialSample, ...]:
        """As the tracker keeps them."""
        return tuple(sample for sample in self._imu if sample.time_ns > time_ns)

    def _velocity(self, at_s: float) -> tuple[float, float]:
        a, b = np.array(self.path(at_s - 0.01)), np.array(self.path(at_s + 0.01))
        north, east = (b - a) / 0.02
        return float(north), float(east)

    def _inertial(self, at_s: float) -> InertialSample:
        a, b, c = (np.array(self.path(at_s + d)) for d in (-0.02, 0.0, 0.02))
        north, east = (a - 2 * b + c) / 0.02**2 + 0.1 * self._rng.standard_normal(2)
        return InertialSample(second(at_s), (float(north), float(east), -GRAVITY), (0.0, 0.0, 0.0))

    # --- the localizer --------------------------------------------------------------------------

    def _fix(self, at_s: float) -> VisionFix:
        north, east = (self.seen or self.path)(at_s) + self.noise_m * self._rng.standard_normal(2)
        latitude, longitude = offset(LATITUDE, LONGITUDE, float(north), float(east))
        covariance = np.eye(3) * self.claimed_m**2
        height = HEIGHT + self.height_m(at_s)
        return VisionFix(
            second(at_s),
            latitude,
            longitude,
            height,
            reset_count=int(at_s >= self.reset_at_s),
            position_covariance_ned=covariance,
            scale_sigma=0.1 if self.by_odometry else None,
        )

    def _offer(self, fix: VisionFix) -> None:
        if self.silent[0] <= self.at_s < self.silent[1]:
            return
        admitted = self.monitor.admit(fix, self.state(), self.attitude_at(fix.time_ns))
        if admitted is not None and not admitted.position_withheld:
            self.passed.append(admitted)
            return
        self.held.append(self.at_s)
        if admitted is not None:
            self.moved.append(self.at_s)
            self.claims.append(admitted.scale_sigma or 0.0)


def taken(flight: Flight, since_s: float) -> float:
    """When the first fix passed after a time."""
    return next((f.time_ns * 1e-9 for f in flight.passed if f.time_ns >= second(since_s)), np.inf)


def jumps(flight: Flight) -> list[float]:
    """Seconds of the fixes that passed with another reset count than the one before."""
    return [
        fix.time_ns * 1e-9
        for before, fix in itertools.pairwise(flight.passed)
        if fix.reset_count != before.reset_count
    ]


def outside(flight: Flight) -> list[float]:
    """Seconds at which a position was let through farther off than its level."""
    found = []
    for fix in flight.passed:
        true = offset(LATITUDE, LONGITUDE, *flight.path(fix.time_ns * 1e-9))
        error = np.hypot(*north_east(*true, fix.latitude_deg, fix.longitude_deg))
        if fix.protection_m is not None and error > fix.protection_m[0]:
            found.append(fix.time_ns * 1e-9)
    return found
