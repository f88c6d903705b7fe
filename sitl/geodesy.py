"""ArduPilot's flat-earth conversion between latitude/longitude and NED metres.

The EKF inverts it, so positions must be converted the same way (Location::get_distance_NE).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians

METRES_PER_DEGREE = 0.011131884502145034e7  # ArduPilot's LOCATION_SCALING_FACTOR, per degree


@dataclass(frozen=True)
class Location:
    """Latitude and longitude in degrees, altitude in metres AMSL."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def ned_of(self, other: Location) -> tuple[float, float, float]:
        """North, east, down (m) from this location to `other`."""
        north, east = north_east(self, other.latitude_deg, other.longitude_deg)
        return north, east, self.altitude_m - other.altitude_m

    def offset(self, north_m: float, east_m: float, down_m: float) -> Location:
        """The location at a NED offset (metres) from this one."""
        latitude = self.latitude_deg + north_m / METRES_PER_DEGREE
        scale = METRES_PER_DEGREE * _longitude_scale(self.latitude_deg, latitude)
        return Location(latitude, self.longitude_deg + east_m / scale, self.altitude_m - down_m)


def north_east(origin: Location, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """North and east metres of a latitude and longitude from `origin`."""
    scale = METRES_PER_DEGREE * _longitude_scale(origin.latitude_deg, latitude_deg)
    return (
        (latitude_deg - origin.latitude_deg) * METRES_PER_DEGREE,
        (longitude_deg - origin.longitude_deg) * scale,
    )


def _longitude_scale(latitude_a_deg: float, latitude_b_deg: float) -> float:
    return max(cos(radians(0.5 * (latitude_a_deg + latitude_b_deg))), 0.01)
