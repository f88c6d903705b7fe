"""Pose priors from the autopilot and other sources, for the start and for the search
after a loss.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from companion.conversions import CameraExtrinsics, camera_rotation, vehicle_prior
from localizer.geometry.geo import NED_FROM_ENU
from localizer.geometry.pose import Array
from localizer.sensors.error_model import SENSORS
from localizer.tracking.motion import AuxiliarySensors
from localizer.types import PoseEstimate, PosePrior
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.messages import Attitude, GimbalAttitude, VehicleState
from mavlink_bridge.vehicle.origin import north_east

_CONST_POSITION = 128  # EKF_CONST_POS_MODE of EKF_STATUS_REPORT (193): it only knows that it is
_ATTITUDE = 1
_GLITCH = 32768  # EKF_GPS_GLITCHING
_HORIZONTAL = 8 | 16  # EKF_POS_HORIZ_REL | EKF_POS_HORIZ_ABS

_LARGEST_SIGMA_M = 5000.0
_AHEAD_S = 0.3  # by which a velocity carries a position on
_RANGE_AGE_S = 0.5  # a rangefinder's reading on the way: 5 m at 10 m/s
_LEAST_UPRIGHT = math.cos(math.radians(25.0))  # else a beam meets the ground far to one side
_UNTOLD_SIGMA_M = 25.0  # of a position of which nobody says where it comes from
_BESIDE_M, _REPORT_S = 3.0, 0.5  # of the receiver: an EKF farther off follows something else


class AutopilotSource(Protocol):
    """Telemetry that the priors read: from the bridge in flight, from a record afterwards."""

    def state(self) -> VehicleState:
        """Newest state of the vehicle."""
        ...

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """The vehicle's attitude at a CLOCK_MONOTONIC time; None if unknown."""
        ...

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """The camera's attitude to NED at a CLOCK_MONOTONIC time; None if unknown."""
        ...

    def local_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's position (north, east, down) from its origin, m, at a CLOCK_MONOTONIC time;
        None if unknown.
        """
        ...


def drift_sigma_m(seconds: float) -> float:
    """Horizontal sigma, m (at most 5 km), that an EKF gains in `seconds` without measurements."""
    return min(SENSORS.ekf_drift.sigma_m(seconds), _LARGEST_SIGMA_M)


def local_near(autopilot: AutopilotSource, time_ns: int) -> tuple[float, ...] | None:
    """The EKF's position (north, east, down) from its origin at time_ns, m; None if unknown. It is
    extrapolated by the velocity for up to 0.3 s after the last report (10 Hz).
    """
    known = autopilot.local_at(time_ns)
    if known is not None:
        return known
    state = autopilot.state()
    position, velocity = state.local_position_ned, state.local_velocity_ned
    ahead_s = (time_ns - state.local_time_ns) * 1e-9
    if position is None or velocity is None or not 0.0 <= ahead_s <= _AHEAD_S:
        return None
    return tuple(p + v * ahead_s for p, v in zip(position, velocity, strict=True))


@dataclass(frozen=True)
class PositionQuality:
    """Quality of the autopilot's position. independent: the position is not derived from our own
    fixes. sigma_m: horizontal, one sigma; None: unknown.
    """

    sigma_m: float | None
    independent: bool


class PositionQualityMonitor:
    """Estimates the quality of the EKF's position from the time of the last GNSS or own fix.
    Thread-safe: the localization thread passes estimates, the bridge's thread states.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._gnss_ns: int | None = None
        self._fix_ns: int | None = None

    def note_fix(self, time_ns: int) -> None:
        """Set the time of the newest own fix that was sent to the EKF."""
        with self._lock:
            self._fix_ns = time_ns

    def at(self, state: VehicleState, now_ns: int, *, on_gnss: bool = True) -> PositionQuality:
        """Quality of this state's position at now_ns. Healthy GNSS is noted as the last absolute
        measurement. on_gnss: whether the EKF uses GNSS.
        """
        healthy = on_gnss and gnss_healthy(state, now_ns) and not state.ekf_flags & _GLITCH
        with self._lock:
            if healthy:
                self._gnss_ns = now_ns
            known = [t for t in (self._gnss_ns, self._fix_ns) if t is not None]
        if healthy:
            own_m = state.gps_h_accuracy_m or 0.0
            return PositionQuality(max(SENSORS.start_m, own_m), independent=True)
        if state.ekf_flags and not state.ekf_flags & _HORIZONTAL:
            return PositionQuality(None, independent=False)
        if not known:
            return PositionQuality(_UNTOLD_SIGMA_M, independent=False)
        return PositionQuality(
            math.hypot(SENSORS.start_m, drift_sigma_m((now_ns - max(known)) * 1e-9)),
            independent=False,
        )


def _is_beside_receiver(state: VehicleState) -> bool:
    """Whether the EKF's position agrees with the GNSS receiver's."""
    ekf = (state.latitude_deg, state.longitude_deg)
    receiver = (state.gps_latitude_deg, state.gps_longitude_deg)
    if ekf[0] is None or ekf[1] is None or receiver[0] is None or receiver[1] is None:
        return False
    apart_m = math.hypot(*north_east(ekf[0], ekf[1], receiver[0], receiver[1]))
    speed_mps = math.hypot(*(state.local_velocity_ned or (0.0, 0.0, 0.0))[:2])
    return apart_m <= _BESIDE_M + _REPORT_S * speed_mps


class AutopilotPose:
    """The camera's pose from the autopilot's position, attitude and gimbal angles.

    on_gnss: whether the EKF uses GNSS, None if unknown; then it counts as using GNSS if the
    receiver reports the same position. A position that results from our own fixes is not marked
    `independent`.
    """

    def __init__(
        self,
        autopilot: AutopilotSource,
        extrinsics: CameraExtrinsics,
        on_gnss: Callable[[], bool | None] = lambda: True,
    ) -> None:
        self._autopilot, self._on_gnss = autopilot, on_gnss
        self._extrinsics = extrinsics
        self.belief = PositionQualityMonitor()

    def add_estimate(self, estimate: PoseEstimate, *, reaches_ekf: bool) -> None:
        """Note the time of an accepted estimate that `reaches_ekf`. Never blocks.

        reaches_ekf: whether positions are sent to the EKF. A fix in shadow mode or on hold does not
        correct the EKF, which may drift; the search region must allow for that.
        """
        if estimate.accepted and reaches_ekf:
            self.belief.note_fix(estimate.exposure_time_ns)

    @property
    def sigma_m(self) -> float | None:
        """Horizontal sigma of the autopilot's position now; None where unknown."""
        return self._quality(self._autopilot.state(), time.monotonic_ns()).sigma_m

    @property
    def sensors(self) -> AuxiliarySensors:
        """Rotation, displacement, height and clearance as functions, for the localizer."""
        return AuxiliarySensors(
            self.rotation, self.displacement, lambda _time_ns: self.height_m, self.clearance_m
        )

    @property
    def height_m(self) -> float | None:
        """The autopilot's altitude as height above the map's origin, m; None: unknown. The world's
        z is smaller by the Earth's curvature.
        """
        altitude_m = self._autopilot.state().altitude_amsl_m
        if altitude_m is None or not math.isfinite(altitude_m):
            return None
        origin_m = self._extrinsics.frame.origin.height_m
        return altitude_m + self._extrinsics.geoid_separation_m - origin_m

    def clearance_m(self, time_ns: int) -> float | None:
        """Height above the ground by the rangefinder, m. None without a reading within 0.5 s of
        that CLOCK_MONOTONIC time, or if the vehicle is tilted by more than 25 degrees.
        """
        state, attitude = self._autopilot.state(), self._autopilot.attitude_at(time_ns)
        away_s = abs(time_ns - state.rangefinder_time_ns) * 1e-9
        if state.rangefinder_m is None or attitude is None or away_s > _RANGE_AGE_S:
            return None
        upright = math.cos(attitude.roll_rad) * math.cos(attitude.pitch_rad)
        return state.rangefinder_m * upright if upright >= _LEAST_UPRIGHT else None

    @property
    def velocity(self) -> Array | None:
        """The EKF's velocity (3,) in the map's axes, m/s; None where unknown."""
        state = self._autopilot.state()
        if state.local_velocity_ned is None or state.ekf_flags & _CONST_POSITION:
            return None
        return np.asarray(NED_FROM_ENU.T @ np.array(state.local_velocity_ned))

    @property
    def knows_heading(self) -> bool:
        """Whether the EKF's attitude, heading included, is valid (EKF_ATTITUDE)."""
        return bool(self._autopilot.state().ekf_flags & _ATTITUDE)

    def prior(self, time_ns: int) -> PosePrior | None:
        """Prior of the camera's pose at a CLOCK_MONOTONIC time; None if position, its sigma,
        attitude or gimbal is unknown. Not `independent` if the EKF's position is our own fixes'.
        """
        state = self._autopilot.state()
        belief = self._quality(state, time_ns)
        if belief.sigma_m is None:
            return None
        prior = vehicle_prior(
            state,
            self._autopilot.attitude_at(time_ns),
            self._autopilot.gimbal_at(time_ns),
            self._extrinsics,
            (belief.sigma_m, float(np.radians(SENSORS.heading_deg))),
            time_ns,
        )
        return replace(prior, independent=belief.independent) if prior is not None else None

    def rotation(self, time_ns: int) -> Array | None:
        """The camera's rotation (3, 3), map axes from camera, at a CLOCK_MONOTONIC time, by the
        reported attitude of the camera to NED; None if unknown.
        """
        gimbal = self._autopilot.gimbal_at(time_ns)
        return camera_rotation(gimbal) if gimbal is not None else None

    def displacement(self, begin_ns: int, end_ns: int) -> tuple[Array, float] | None:
        """Displacement (3,) in the map's axes between two times by the EKF, and its sigma (m); None
        if unknown.

        It is inertial while no fix of ours is sent, as during a tentative track. The axes at the
        map's origin are used instead of the vehicle's: 0.1° at 10 km.
        """
        state = self._autopilot.state()
        if state.ekf_flags & _CONST_POSITION or not state.ekf_flags & _HORIZONTAL:
            return None
        begin, end = self._autopilot.local_at(begin_ns), self._autopilot.local_at(end_ns)
        if begin is None or end is None:
            return None
        way = NED_FROM_ENU.T @ (np.array(end[:3]) - np.array(begin[:3]))
        belief = self._quality(state, end_ns)
        if belief.sigma_m is None:
            return None
        # The position's sigma now against that at the begin is what the velocity may be off.
        elapsed_s = (end_ns - begin_ns) * 1e-9
        drift = SENSORS.ekf_drift
        since_s = max(elapsed_s, math.sqrt(2.0 * belief.sigma_m / drift.acceleration_mps2))
        speed_error = math.hypot(drift.speed_mps, drift.acceleration_mps2 * since_s)
        return way, 0.5 + speed_error * elapsed_s

    def _quality(self, state: VehicleState, now_ns: int) -> PositionQuality:
        known = self._on_gnss()
        on_gnss = _is_beside_receiver(state) if known is None else known
        return self.belief.at(state, now_ns, on_gnss=on_gnss)
