"""The dataclasses of the bridge's public interface; none is a MAVLink message.

Times are CLOCK_MONOTONIC nanoseconds of the exposure or measurement; heights are above the WGS84
ellipsoid; NED is north, east, down; angles are radians, aerospace roll, pitch, yaw from true north.
None means unknown; NaN has this meaning in MAVLink fields and in arrays only (`or_nan`).
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mavlink_bridge import quaternion as quat
from mavlink_bridge.errors import FixError
from mavlink_bridge.quaternion import Quaternion

Array = NDArray[np.float64]
_FASTEST_MPS = 1000.0
_LEAST_KNOWN_M = 1e5  # of a sigma or an accuracy: beyond it nothing is known, and floats overflow
_UNIT = 2e-3  # by which a quaternion's square may be off
_LARGEST_SIGMA = 1e3  # of an angle or a speed


class HealthLevel(enum.Enum):
    """The localizer's health, sent as the heartbeat's system status."""

    STARTING = "starting"
    OK = "ok"
    DEGRADED = "degraded"
    FAILED = "failed"


Figures = dict[str, int | float | str | None]
"""Counters and measures by name, for a record; None where one is not known."""


def or_nan(value: float | None) -> float:
    """A MAVLink field's value: NaN instead of None."""
    return math.nan if value is None else value


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


def _check_rotation(what: str, q: Quaternion) -> None:
    if not (len(q) == 4 and abs(sum(one * one for one in q) - 1.0) <= _UNIT):
        raise FixError(
            f"{what}: {q} is no rotation; give a unit quaternion (w, x, y, z), None where unknown"
        )


def _check_accuracies(what: str, accuracies: tuple[float | None, ...]) -> None:
    if not all(a is None or 0.0 <= a <= _LEAST_KNOWN_M for a in accuracies):
        raise FixError(
            f"{what}: accuracies must be 0 to {_LEAST_KNOWN_M:g} m, None where unknown; got "
            f"{accuracies}"
        )


def _is_covariance(P: Array) -> bool:
    if P.shape != (3, 3) or not np.all(np.abs(P) <= _LEAST_KNOWN_M**2):
        return False
    scale = max(float(np.abs(P).max()), 1e-12)
    symmetric = bool(np.abs(P - P.T).max() <= 1e-6 * scale)
    return symmetric and float(np.linalg.eigvalsh(P)[0]) >= -1e-6 * scale


def horizontal_sigma_m(P: Array) -> float:
    """1 sigma in the worst horizontal direction, m, of an NED covariance P (3, 3), m^2."""
    return math.sqrt(max(float(np.linalg.eigvalsh(P[:2, :2])[-1]), 0.0))


@dataclass(frozen=True)
class VisionFix:
    """One position (and attitude) of the vehicle's body from vision.

    Raises `FixError` for values that no autopilot should receive.
    """

    time_ns: int
    """Of the exposure."""
    latitude_deg: float
    longitude_deg: float
    height_m: float
    """Of the body's origin, not of the camera, above the ellipsoid."""
    quaternion: Quaternion | None = None
    """Body to NED, from true north; without it the yaw guard does not check the fix."""
    position_covariance_ned: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3), m^2."""
    attitude_sigma_rad: float = 0.02
    """1 sigma of each angle."""
    reset_count: int = 0
    """Number of jumps of the localizer's estimate so far; it never decreases. A receiver compares
    it with that of the last fix it has got, so a dropped fix loses no jump.
    """
    quality: int = 100
    """0..100, for ODOMETRY."""
    velocity_ned: tuple[float, float, float] | None = None
    """m/s, where it was measured; None lets the bridge derive it from the fixes."""
    velocity_sigma_mps: float = 0.3
    """1 sigma along each axis of `velocity_ned`."""
    protection_m: tuple[float, float] | None = None
    """Horizontal and vertical protection level: bounds that the errors exceed with a probability of
    1e-3 at most; None: not stated."""
    scale_sigma: float | None = None
    """Of a fix that visual odometry propagated from an earlier one: relative sigma of its velocity,
    the same error in consecutive fixes. None: not by odometry."""
    position_withheld: bool = False
    """The position is too uncertain to be sent; its change since the fix before is not."""

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
        if self.quaternion is not None:
            _check_rotation("vision fix", self.quaternion)
        if self.protection_m is not None and not all(p >= 0.0 for p in self.protection_m):
            raise FixError(
                f"vision fix: protection levels must not be negative, got {self.protection_m}"
            )
        sigmas = (self.attitude_sigma_rad, self.velocity_sigma_mps, self.scale_sigma or 0.0)
        if not all(0.0 <= sigma <= _LARGEST_SIGMA for sigma in sigmas):
            raise FixError(
                f"vision fix: attitude, velocity, scale sigma must be 0 to {_LARGEST_SIGMA:g}, got "
                f"{sigmas}"
            )

    @property
    def by_odometry(self) -> bool:
        """Whether visual odometry propagated the fix from an earlier one."""
        return self.scale_sigma is not None

    @property
    def horizontal_sigma_m(self) -> float:
        """1 sigma along the worst horizontal direction, m."""
        return horizontal_sigma_m(self.position_covariance_ned)

    @property
    def vertical_sigma_m(self) -> float:
        """1 sigma of the height, m."""
        return math.sqrt(max(float(self.position_covariance_ned[2, 2]), 0.0))

    @property
    def yaw_rad(self) -> float | None:
        """Heading from true north, rad; None if the attitude is unknown."""
        return None if self.quaternion is None else quat.to_euler(self.quaternion)[2]


@dataclass(frozen=True)
class TargetReport:
    """A target's position for the ground station. Raises `FixError` for impossible values."""

    time_ns: int
    """Of the exposure in which it was seen."""
    latitude_deg: float
    longitude_deg: float
    height_m: float
    """Above the ellipsoid."""
    velocity_ned: tuple[float, float, float] | None = None
    """m/s."""
    h_accuracy_m: float | None = None
    """1 sigma, horizontal (over both directions), `elsewhere` included."""
    v_accuracy_m: float | None = None
    """1 sigma of the height, `elsewhere` included."""
    pixel: tuple[float, float] | None = None
    """Its place in the picture (x, y), normalised 0..1."""
    target_id: int = 0
    elsewhere: float = 0.0
    """Probability that it is on another surface than the one reported (a roof's edge, say)."""
    rectangle: tuple[float, float, float, float] | None = None
    """Left, top, right, bottom, normalised 0..1."""
    velocity_accuracy_mps: float | None = None
    """1 sigma, horizontal (over both directions)."""
    clicked: bool = False
    """The operator pointed at it (and no detector)."""
    coasting: bool = False
    """Nothing of it is seen now; its place is known from before."""

    def __post_init__(self) -> None:
        _check_position("target report", self.latitude_deg, self.longitude_deg, self.height_m)
        _check_velocity("target report", self.velocity_ned)
        accuracies = (self.h_accuracy_m, self.v_accuracy_m, self.velocity_accuracy_mps)
        _check_accuracies("target report", accuracies)
        if not -1e-6 <= self.elsewhere <= 1.0 + 1e-6:  # a sum of shares is not quite 1
            raise FixError(f"target report: elsewhere is a probability, got {self.elsewhere}")
        for place in (self.pixel, self.rectangle):
            if place is not None and not all(0.0 <= c <= 1.0 for c in place):
                raise FixError(
                    f"target report: {place} is not inside the image; give shares of its width "
                    "and height, 0 to 1"
                )


@dataclass(frozen=True)
class TargetEnd:
    """Notice that the target of this number is no longer reported."""

    target_id: int


@dataclass(frozen=True)
class CameraView:
    """Camera position, attitude and ground point in the image's centre (CAMERA_FOV_STATUS)."""

    time_ns: int
    """Of the exposure."""
    latitude_deg: float
    longitude_deg: float
    height_m: float
    """Of the camera, above the ellipsoid."""
    quaternion_ned: tuple[float, float, float, float]
    """(w, x, y, z), camera body (x along the boresight, y right, z down) to NED."""
    image_latitude_deg: float | None = None
    """The point on the ground in the picture's centre; None where the ray meets nothing."""
    image_longitude_deg: float | None = None
    image_height_m: float | None = None
    h_accuracy_m: float | None = None
    """1 sigma of the camera's position, horizontal (over both directions)."""
    v_accuracy_m: float | None = None
    """1 sigma of its height."""
    fov_deg: tuple[float, float] | None = None
    """Horizontal and vertical field of view at this zoom; None: the configured one."""

    def __post_init__(self) -> None:
        if not all(0.0 < angle < 180.0 for angle in self.fov_deg or ()):
            raise FixError(f"camera view: no field of view: {self.fov_deg}")
        _check_position("camera view", self.latitude_deg, self.longitude_deg, self.height_m)
        image = (self.image_latitude_deg, self.image_longitude_deg, self.image_height_m)
        _check_position("camera view's picture", *(value or 0.0 for value in image))
        _check_accuracies("camera view", (self.h_accuracy_m, self.v_accuracy_m))
        _check_rotation("camera view", self.quaternion_ned)


@dataclass(frozen=True)
class TrackRequest:
    """A request of the operator to track a point or rectangle of the image."""

    kind: str
    """"point", "rectangle" or "stop"."""
    time_ns: int
    """When the command came."""
    coordinates: tuple[float, ...] = ()
    """Normalised 0..1: (x, y) of a point; left, top, right, bottom; () of a stop."""
    radius: float = 0.0
    """Of a point, normalised 0..1."""
    number: int = 0
    """Of the target that a point or rectangle begins; of the one that a stop ends, 0: of all."""
    asked_by: str = "ground station"
    """Where the operator did; the target is called after it."""


@dataclass(frozen=True)
class PlaceHint:
    """Vehicle position given by the operator; it limits the search and is never a fix."""

    latitude_deg: float
    longitude_deg: float
    radius_m: float
    """1 sigma of the stated position, m."""


@dataclass(frozen=True)
class Attitude:
    """The vehicle's attitude at a time, body (FRD) to NED."""

    time_ns: int
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z)."""
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the body (roll, pitch, yaw), rad/s."""
    gyro_heading_rad: float = 0.0
    """The heading's rate integrated since the link began, unwrapped: no reference, no resets."""


@dataclass(frozen=True)
class InertialSample:
    """IMU measurement (RAW_IMU, HIGHRES_IMU) in body axes FRD, not filtered by an estimator."""

    time_ns: int
    specific_force: tuple[float, float, float]
    """m/s^2, about (0, 0, -9.8) at rest."""
    rates: tuple[float, float, float]
    """rad/s, biases included."""


@dataclass(frozen=True)
class GimbalAttitude:
    """The gimbal's attitude to NED at a time, whatever frame the message used."""

    time_ns: int
    roll_rad: float
    """From the horizon, as pitch."""
    pitch_rad: float
    yaw_rad: float
    """From true north."""
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z), gimbal (x forward, y right, z down) to NED."""
    source: str
    """The message it came from; "fixed" of a camera without gimbal."""


@dataclass(frozen=True)
class Origin:
    """The EKF origin, or another position with altitude AMSL (WGS84)."""

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float


@dataclass(frozen=True)
class VehicleState:
    """Snapshot of the vehicle's telemetry; None if not received.

    Times are those of the message on CLOCK_MONOTONIC, 0 before the first.
    """

    connected: bool = False
    """A heartbeat came in the last 3 s."""
    system_id: int | None = None
    component_id: int | None = None
    autopilot: str = "unknown"
    """"ardupilot", "px4" or another name."""
    version: tuple[int, int, int] | None = None
    profile: str = "generic"
    """Name of the firmware's profile (mavlink_bridge/vehicle/profile.py)."""
    armed: bool = False
    custom_mode: int = 0
    mode: str = ""
    """The flight mode's name."""
    system_status: int = 0
    """MAV_STATE."""
    ekf_flags: int = 0
    """EKF_STATUS_FLAGS; PX4's ESTIMATOR_STATUS_FLAGS share their first bits."""
    ekf_horizontal_variance: float | None = None
    """Test ratio of the position's innovations, rejected above 1."""
    origin: Origin | None = None
    """Of the EKF, as it was read."""
    latitude_deg: float | None = None
    """The EKF's position (GLOBAL_POSITION_INT), with the three that follow."""
    longitude_deg: float | None = None
    altitude_amsl_m: float | None = None
    altitude_relative_m: float | None = None
    """Above the home position."""
    position_time_ns: int = 0
    local_position_ned: tuple[float, float, float] | None = None
    """Metres from the EKF's origin."""
    local_velocity_ned: tuple[float, float, float] | None = None
    """m/s."""
    local_time_ns: int = 0
    gps_fix_type: int = 0
    """GPS_FIX_TYPE; 3 is a 3D fix."""
    gps_latitude_deg: float | None = None
    """The receiver's own position (GPS_RAW_INT)."""
    gps_longitude_deg: float | None = None
    gps_altitude_amsl_m: float | None = None
    gps_height_m: float | None = None
    """Above the ellipsoid, where the receiver says it."""
    gps_h_accuracy_m: float | None = None
    """As the receiver claims it."""
    gps_time_ns: int = 0
    rc_channels_us: tuple[int, ...] = ()
    """Pulse widths of the pilot's channels, first to eighteenth."""
    reboots: int = 0
    """How often the autopilot started over on this link."""
    clock_offset_ns: int | None = None
    """CLOCK_MONOTONIC minus the autopilot's boot time."""
    clock_source: str = "none"
    """What the offset comes from."""
    pressure_altitude_m: float | None = None
    """Of the barometer alone in the standard atmosphere: only its changes mean something."""
    pressure_time_ns: int = 0
    rangefinder_m: float | None = None
    """From the vehicle to what lies below it, along its own axis (DISTANCE_SENSOR)."""
    rangefinder_time_ns: int = 0
