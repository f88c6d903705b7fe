"""Error models of all sensors other than the camera: one value for each quantity, with its source.

Receiver and gyros are in `mavlink_bridge/vehicle/sensor_errors.py`. Priors, jump check, reachable
region, motion check, search, odometry, integrity monitor, calibration watch and targets use
`SENSORS`. All values are one standard deviation along an axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

GRAVITY_MPS2 = 9.80665


@dataclass(frozen=True)
class DeadReckoningError:
    """Error growth of a position without measurements: an initial velocity error, and a constant
    acceleration error.
    """

    speed_mps: float
    acceleration_mps2: float

    def sigma_m(self, seconds: float) -> float:
        """Horizontal sigma (m, per axis) after so many seconds."""
        t = max(seconds, 0.0)
        return math.hypot(self.speed_mps * t, 0.5 * self.acceleration_mps2 * t * t)


@dataclass(frozen=True)
class SensorErrorModel:
    """Sensors of the aircraft, its map and its clock."""

    # Roll and pitch of autopilot and gimbal together. tilt: about their constant error; alignment:
    # that constant, of which datasheets give 0.5 to 1 degree for the gimbal's zero.
    tilt_deg: float = 0.4
    alignment_deg: float = 0.8
    # An EKF without position levels itself by accelerometers that also feel the flight.
    unaided_tilt_deg: float = 2.0
    tilt_change_deg: float = 0.2  # over the seconds between two keyframes
    # Compass. Calibrated and away from steel (ArduPilot asks for 5 degrees); over a town.
    heading_deg: float = 4.0
    town_heading_deg: float = 10.0
    heading_change_deg: float = 0.6  # gyros over the seconds between two keyframes
    # Vision against the better of gyros and autopilot, medians of a second, in 24 recorded flights:
    # at most 0.6 degrees from one to the next, 1.5 over 5 s, 2.6 over 10 s.
    heading_step_deg: float = 1.0
    tilt_step_deg: float = 0.6  # gimbal and vision, likewise
    # Barometer against the map's datum; since the take-off, with a front; over some seconds; over
    # the seconds between two keyframes.
    height_m: float = 3.0
    height_since_takeoff_m: float = 6.0
    height_of_late_m: float = 2.0
    climb_m: float = 0.3
    # Its metres are those of the standard atmosphere: 16 % too many at -25 degrees, 9 % too few at
    # 45, of what the aircraft climbed.
    climb_share: float = 0.16
    # Random walk of the velocity in the free integral of the IMU, m/s per root second: noise and
    # vibration. With 0.05 the calibration watch takes an EKF that late positions turned for a wrong
    # camera; with 0.1 the monitor takes an announced jump in a hover.
    imu_noise: float = 0.06
    # Of tilt and accelerometer together, in north and east, m/s^2 per root second.
    imu_bias_walk: float = 0.002
    # An EKF that has lost its position. 5 s without fixes moved ArduPilot and the embedded vehicle
    # by 1.0 m in the mean and 1.8 m at most (64 flights of dropout-5s): 0.8 m an axis; the model's
    # sigma is 1.1 m, because simulated sensors do not vibrate.
    ekf_speed_mps: float = 0.15
    # The velocity with which a free integral of the IMU begins, when it was the autopilot's while
    # that followed our own fixes.
    integral_speed_mps: float = 0.5
    start_m: float = 5.0  # of the autopilot's position where tracking begins
    # The map: what displaces it as a whole, fitted by `python -m benchmarks.protection`; and what
    # displaces each patch of it by itself, likeliest over three flights over other visits.
    map_m: float = 0.28
    map_height_m: float = 0.4
    map_patch_m: float = 0.07
    map_patch_length_m: float = 20.0
    time_bias_s: float = 0.01  # of the camera's clock, what its calibration leaves

    @property
    def mounted_tilt_deg(self) -> float:
        """Sigma of roll and pitch of gimbal and autopilot, with the constant error."""
        return math.hypot(self.tilt_deg, self.alignment_deg)

    @property
    def ekf_drift(self) -> DeadReckoningError:
        """Drift of an EKF without absolute measurements, caused by its tilt error."""
        return DeadReckoningError(self.ekf_speed_mps, self._leak_mps2)

    @property
    def inertial_drift(self) -> DeadReckoningError:
        """Drift of the integrated IMU, caused by its tilt error."""
        return DeadReckoningError(self.integral_speed_mps, self._leak_mps2)

    @property
    def _leak_mps2(self) -> float:
        return GRAVITY_MPS2 * math.sin(math.radians(self.tilt_deg))


SENSORS = SensorErrorModel()
