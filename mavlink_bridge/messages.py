"""The dataclasses that cross the bridge's border; none of them is a MAVLink message.

Times are CLOCK_MONOTONIC nanoseconds of the exposure or measurement; heights are above the WGS84
ellipsoid; NED is north, east, down; angles are radians, aerospace roll, pitch, yaw from true north.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mavlink_bridge.errors import FixError

Array = NDArray[np.float64]
NAN = math.nan
_FASTEST_MPS = 1000.0
_LEAST_KNOWN_M = 1e5  # of a sigma or an accuracy: beyond it nothing is known, and floats overflow
_LARGEST_SIGMA = 1e3  # of an angle or a speed


class HealthLevel(enum.Enum):
    """The localizer's health, as the heartbeat's system status tells it."""

    STARTING = "starting"
    OK = "ok"
    DEGRADED = "degraded"
    FAILED = "failed"


def without_figures(text: str) -> str:
    """A line for the operator without its numbers: what changes in them only is no news."""
    return "".join(c for c in text if not c.isdigit() and c not in "+-.")


def _check_position(what: str, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0 and abs(height_m) < 2e4):
        raise FixError(
            f"{what}: latitude {latitude_deg}, longitude {longitude_deg}, height {height_m} m is "
            "no place on Earth; give degrees and metres above the ellipsoid"
        )


def _check_velocity(what: str, velocity_ned: tuple[float, float, float] | None) -> None:
    if velocity_ned is not None and not all(abs(v) <= _FASTEST_MPS for v in velocity_ned):
        raise FixError(
            f"{what}: velocity {velocity_ned} is not finite or above {_FASTEST_MPS:.0f} m/s; give "
            "m/s, or None where it is unknown"
        )


def _is_covariance(P: Array) -> bool:
    if P.shape != (3, 3) or not np.all(np.abs(P) <= _LEAST_KNOWN_M**2):
        return False
    scale = max(float(np.abs(P).max()), 1e-12)
    symmetric = bool(np.abs(P - P.T).max() <= 1e-6 * scale)
    return symmetric and float(np.linalg.eigvalsh(P)[0]) >= -1e-6 * scale


@dataclass(frozen=True)
class VisionFix:
    """One position (and attitude) of the vehicle's body, seen by the localizer.

    position_covariance_ned: (3, 3) m^2. roll, pitch, yaw: body to NED; NaN where unknown.
    velocity_ned: m/s with its sigma where it was measured; None lets the bridge derive it.
    reset: this fix carries a jump of the localizer's own estimate. quality: 0..100.
    """

    time_ns: int
    latitude_deg: float
    longitude_deg: float
    height_m: float
    roll_rad: float = NAN
    pitch_rad: float = NAN
    yaw_rad: float = NAN
    position_covariance_ned: Array = field(default_factory=lambda: np.eye(3))
    attitude_sigma_rad: float = 0.02
    reset: bool = False
    quality: int = 100
    velocity_ned: tuple[float, float, float] | None = None
    velocity_sigma_mps: float = 0.3

    def __post_init__(self) -> None:
        _check_position("vision fix", self.latitude_deg, self.longitude_deg, self.height_m)
        P = np.asarray(self.position_covariance_ned, dtype=np.float64)
        if not _is_covariance(P):
            raise FixError(
                "vision fix: covariance must be (3, 3), symmetric, not negative and at most "
                f"{_LEAST_KNOWN_M**2:g} m^2; got {P.tolist()}"
            )
        object.__setattr__(self, "position_covariance_ned", P)
        if not 0 <= self.quality <= 100:
            raise FixError(f"vision fix: quality must be 0..100, got {self.quality}")
        _check_velocity("vision fix", self.velocity_ned)
        angles = (self.roll_rad, self.pitch_rad, self.yaw_rad)
        if any(math.isinf(angle) for angle in angles):
            raise FixError(f"vision fix: attitude {angles} is infinite; give NaN where unknown")
        sigmas = (self.attitude_sigma_rad, self.velocity_sigma_mps)
        if not all(0.0 <= sigma <= _LARGEST_SIGMA for sigma in sigmas):
            raise FixError(
                f"vision fix: attitude and velocity sigma must be 0 to {_LARGEST_SIGMA:g}, got "
                f"{sigmas}"
            )


@dataclass(frozen=True)
class TargetReport:
    """A target's position for the ground station. pixel: (x, y), normalised 0..1, or None.

    elsewhere: the probability that the target is on another surface than the one reported (a roof's
    edge, say); the accuracies include it.
    """

    time_ns: int
    latitude_deg: float
    longitude_deg: float
    height_m: float
    velocity_ned: tuple[float, float, float] | None = None
    h_accuracy_m: float = NAN
    v_accuracy_m: float = NAN
    pixel: tuple[float, float] | None = None
    target_id: int = 0
    elsewhere: float = 0.0
    rectangle: tuple[float, float, float, float] | None = None
    """Left, top, right, bottom, normalised 0..1."""

    def __post_init__(self) -> None:
        _check_position("target report", self.latitude_deg, self.longitude_deg, self.height_m)
        _check_velocity("target report", self.velocity_ned)
        accuracies = (self.h_accuracy_m, self.v_accuracy_m)
        if not all(math.isnan(a) or 0.0 <= a <= _LEAST_KNOWN_M for a in accuracies):
            raise FixError(
                f"target report: accuracies must be 0 to {_LEAST_KNOWN_M:g} m, NaN where unknown; "
                f"got {accuracies}"
            )
        for place in (self.pixel, self.rectangle):
            if place is not None and not all(0.0 <= c <= 1.0 for c in place):
                raise FixError(
                    f"target report: {place} is not inside the picture; give shares of its width "
                    "and height, 0 to 1"
                )


@dataclass(frozen=True)
class TargetEnd:
    """Nothing is to be told of that target any more."""

    target_id: int


@dataclass(frozen=True)
class CameraView:
    """Where the camera is and what it looks at, for CAMERA_FOV_STATUS.

    quaternion_ned: (w, x, y, z), camera body (x along the boresight, y right, z down) to NED.
    image_*: the point on the ground in the picture's centre; NaN where the ray meets nothing.
    """

    time_ns: int
    latitude_deg: float
    longitude_deg: float
    height_m: float
    quaternion_ned: tuple[float, float, float, float]
    image_latitude_deg: float = NAN
    image_longitude_deg: float = NAN
    image_height_m: float = NAN

    def __post_init__(self) -> None:
        _check_position("camera view", self.latitude_deg, self.longitude_deg, self.height_m)
        image = (self.image_latitude_deg, self.image_longitude_deg, self.image_height_m)
        if all(math.isfinite(value) for value in image):
            _check_position("camera view's picture", *image)
        if not all(abs(q) <= 1.001 for q in self.quaternion_ned):
            raise FixError(f"camera view: {self.quaternion_ned} is no rotation")


@dataclass(frozen=True)
class TrackRequest:
    """What the operator asked the camera component to track; normalised image coordinates 0..1.

    kind: "point" with (x, y), "rectangle" with (left, top, right, bottom), "stop" with ().
    """

    kind: str
    time_ns: int
    coordinates: tuple[float, ...] = ()
    radius: float = 0.0


@dataclass(frozen=True)
class Attitude:
    """The vehicle's attitude at a time. quaternion: (w, x, y, z), body (FRD) to NED.

    rates: body angular rates (roll, pitch, yaw) in rad/s. gyro_heading_rad: the heading's rate
    integrated since the link began, unwrapped; it has no reference but no resets either.
    """

    time_ns: int
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    quaternion: tuple[float, float, float, float]
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_heading_rad: float = 0.0


@dataclass(frozen=True)
class InertialSample:
    """What the IMU read (RAW_IMU, HIGHRES_IMU), before any estimator: body axes FRD.

    specific_force: m/s^2, about (0, 0, -9.8) at rest; rates: rad/s, biases included.
    """

    time_ns: int
    specific_force: tuple[float, float, float]
    rates: tuple[float, float, float]


@dataclass(frozen=True)
class GimbalAttitude:
    """The gimbal's attitude at a time, to NED, resolved from whatever frame the message used.

    roll and pitch are relative to the horizon, yaw to true north; yaw_vehicle is relative to the
    vehicle's heading. quaternion: (w, x, y, z), gimbal (x forward, y right, z down) to NED.
    source: the message it came from.
    """

    time_ns: int
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    yaw_vehicle_rad: float
    quaternion: tuple[float, float, float, float]
    source: str


@dataclass(frozen=True)
class Origin:
    """The EKF origin: WGS84 degrees, metres AMSL."""

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float


@dataclass(frozen=True)
class VehicleState:
    """A snapshot of what the vehicle says about itself; None or NaN where it has not said it."""

    connected: bool = False
    system_id: int | None = None
    component_id: int | None = None
    autopilot: str = "unknown"
    version: tuple[int, int, int] | None = None
    profile: str = "generic"
    vehicle_type: int = 0
    armed: bool = False
    custom_mode: int = 0
    mode: str = ""
    system_status: int = 0
    ekf_flags: int = 0
    ekf_velocity_variance: float = NAN
    ekf_horizontal_variance: float = NAN
    ekf_vertical_variance: float = NAN
    ekf_compass_variance: float = NAN
    origin: Origin | None = None
    latitude_deg: float = NAN
    longitude_deg: float = NAN
    altitude_amsl_m: float = NAN
    altitude_relative_m: float = NAN
    position_time_ns: int = 0
    local_position_ned: tuple[float, float, float] | None = None
    local_velocity_ned: tuple[float, float, float] | None = None
    local_time_ns: int = 0
    gps_fix_type: int = 0
    gps_satellites: int = 0
    gps_latitude_deg: float = NAN
    gps_longitude_deg: float = NAN
    gps_altitude_amsl_m: float = NAN
    gps_height_m: float = NAN  # above the ellipsoid, where the receiver says it
    gps_h_accuracy_m: float = NAN
    gps_time_ns: int = 0
    rc_channels_us: tuple[int, ...] = ()
    rc_time_ns: int = 0
    heartbeat_age_s: float = math.inf
    reboots: int = 0
    clock_offset_ns: int | None = None
    clock_source: str = "none"
    last_text: str = ""
    pressure_altitude_m: float = NAN
    """Of the barometer alone in the standard atmosphere: only its changes mean something."""
    pressure_time_ns: int = 0
