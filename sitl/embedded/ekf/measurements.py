"""Measurements for the EKF."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GpsData:
    """A GNSS solution. Velocities: NED m/s; None if the receiver measures none. Accuracies: m and
    m/s. yaw_rad: None without a heading.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    horizontal_velocity: tuple[float, float] | None
    vertical_velocity: float | None
    horizontal_accuracy: float
    speed_accuracy: float
    satellites: int
    hdop: float
    yaw_rad: float | None = None

    @property
    def good(self) -> bool:
        """Whether it passes the default thresholds of EK3_GPS_CHECK."""
        return (
            self.satellites >= 6
            and self.hdop <= 2.5
            and self.horizontal_accuracy <= 5.0
            and self.speed_accuracy <= 1.5
        )


@dataclass(frozen=True)
class ExternalPosition:
    """A position from the companion: NED metres from the EKF origin, sigma in metres. yaw_rad: None
    if not measured.

    reset: the sender announces a position jump. is_global: received as latitude and longitude
    (PX4's auxiliary global position).
    """

    position: tuple[float, float, float]
    sigma: float
    yaw_rad: float | None
    yaw_sigma: float
    reset: bool
    is_global: bool = False


@dataclass(frozen=True)
class ExternalVelocity:
    """A velocity from the companion, NED m/s. is_delta: derived from a position change."""

    velocity: tuple[float, float, float]
    sigma: float
    is_delta: bool = False


@dataclass(frozen=True)
class Baro:
    """Height above the home plane in metres."""

    height: float


@dataclass(frozen=True)
class Compass:
    """Heading from true north in radians."""

    yaw: float


Measurement = GpsData | ExternalPosition | ExternalVelocity | Baro | Compass
