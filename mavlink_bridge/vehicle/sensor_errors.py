"""Error model of the vehicle's GNSS receiver and gyros: one value for each quantity, with source.

`localizer/sensors/error_model.py` has the localizer's values; no quantity is in both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class VehicleSensorErrors:
    """One standard deviation of each sensor, along an axis."""

    gnss_m: float = 2.5  # of a receiver that does not say (u-blox CEP in the open)
    gnss_least_m: float = 1.0  # of one that claims less
    ekf_on_gnss_m: float = 1.5
    # Vision against the gyros, medians of a second, in 24 recorded flights: 1.5 degrees over 5 s,
    # 2.6 over 10 s.
    gyro_drift_radps: float = math.radians(0.25)

    def gnss_sigma_m(self, claimed_m: float | None, most_m: float) -> float:
        """GNSS sigma (m) of a stated accuracy (None: not stated), from 1 m to most_m."""
        said = self.gnss_m if claimed_m is None else claimed_m
        return min(max(said, self.gnss_least_m), most_m)


VEHICLE_SENSORS = VehicleSensorErrors()
