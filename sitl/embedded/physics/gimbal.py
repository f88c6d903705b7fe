"""A stabilised gimbal as ArduPilot drives and reports one (MNT1_TYPE 7 or 1).

Roll and pitch are held in the earth frame, yaw is measured from the vehicle's nose. The flags are
those ArduPilot always sets: ROLL_LOCK, PITCH_LOCK, YAW_IN_VEHICLE_FRAME, and YAW_LOCK while yaw is
held in the earth frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import atan2, cos, hypot, isnan, radians, sin

from sitl.embedded.parameters import Parameters
from sitl.embedded.physics.rotation import Array, quaternion, wrap_pi
from sitl.geodesy import Location

FLAG_NEUTRAL, FLAG_ROLL_LOCK, FLAG_PITCH_LOCK, FLAG_YAW_LOCK = 2, 4, 8, 16
FLAG_YAW_IN_VEHICLE_FRAME = 32
_SERVO = 1  # MNT1_TYPE
_SLEW = radians(60.0)  # rad/s of the motors


class GimbalMode(Enum):
    """What the gimbal points at."""

    NEUTRAL = "neutral"
    ANGLE = "angle"
    RATE = "rate"
    LOCATION = "location"


@dataclass
class Gimbal:
    """The first mount (instance 1). Pitch is measured from the horizon, up positive; yaw from the
    vehicle's nose. yaw_locked: yaw is held in the earth frame.
    """

    parameters: Parameters
    mode: GimbalMode = GimbalMode.NEUTRAL
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0  # from the vehicle's nose
    yaw_locked: bool = False
    _wanted_pitch: float = 0.0
    _wanted_yaw: float = 0.0
    _rates: tuple[float, float] = (0.0, 0.0)
    _roi: Location | None = None

    @property
    def fitted(self) -> bool:
        """Whether a mount is configured."""
        return self.parameters["MNT1_TYPE"] > 0

    @property
    def flags(self) -> int:
        """GIMBAL_DEVICE_FLAGS of GIMBAL_DEVICE_ATTITUDE_STATUS."""
        locked = self.mode is GimbalMode.LOCATION or (
            self.mode in (GimbalMode.ANGLE, GimbalMode.RATE) and self.yaw_locked
        )
        return (
            FLAG_ROLL_LOCK
            | FLAG_PITCH_LOCK
            | FLAG_YAW_IN_VEHICLE_FRAME
            | (FLAG_YAW_LOCK if locked else 0)
            | (FLAG_NEUTRAL if self.mode is GimbalMode.NEUTRAL else 0)
        )

    @property
    def attitude(self) -> Array:
        """True quaternion (4,): earth-frame roll and pitch, vehicle-frame yaw."""
        return quaternion(self.roll_rad, self.pitch_rad, self.yaw_rad)

    def reported(self, vehicle_roll_rad: float, vehicle_pitch_rad: float) -> Array:
        """The reported attitude quaternion (4,). For a brushless gimbal (type 7) it is the true
        one.

        For a servo gimbal (type 1) ArduPilot sends the servo angles minus the vehicle's roll and
        pitch, under the same earth-frame flags.
        """
        if self.parameters["MNT1_TYPE"] != _SERVO:
            return self.attitude
        c, s = cos(self.yaw_rad), sin(self.yaw_rad)
        lean_roll = c * vehicle_roll_rad + s * vehicle_pitch_rad
        lean_pitch = -s * vehicle_roll_rad + c * vehicle_pitch_rad
        limits = [
            (
                radians(self.parameters[f"MNT1_{axis}_MIN"]),
                radians(self.parameters[f"MNT1_{axis}_MAX"]),
            )
            for axis in ("ROLL", "PITCH")
        ]
        roll = min(max(self.roll_rad - lean_roll, limits[0][0]), limits[0][1])
        pitch = min(max(self.pitch_rad - lean_pitch, limits[1][0]), limits[1][1])
        return quaternion(roll, pitch, self.yaw_rad)

    def point(self, pitch_deg: float, yaw_deg: float, *, yaw_locked: bool) -> None:
        """MAV_CMD_DO_MOUNT_CONTROL, MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW: point at these angles. NaN
        keeps an angle. yaw_locked: yaw_deg counts from north.
        """
        self.mode = GimbalMode.ANGLE
        self.yaw_locked = yaw_locked
        if not isnan(pitch_deg):
            self._wanted_pitch = radians(pitch_deg)
        if not isnan(yaw_deg):
            self._wanted_yaw = radians(yaw_deg)

    def rotate(self, pitch_rate_deg: float, yaw_rate_deg: float, *, yaw_locked: bool) -> None:
        """Rotate at a rate (degrees per second)."""
        self.mode = GimbalMode.RATE
        self.yaw_locked = yaw_locked
        self._rates = (radians(pitch_rate_deg), radians(yaw_rate_deg))

    def look_at(self, location: Location | None) -> None:
        """MAV_CMD_DO_SET_ROI_LOCATION: keep pointing at a location; None: return to neutral."""
        self._roi = location
        self.mode = GimbalMode.NEUTRAL if location is None else GimbalMode.LOCATION

    def neutral(self) -> None:
        """Return to MNT1_NEUTRAL_*."""
        self.mode = GimbalMode.NEUTRAL

    def update(self, vehicle: Location | None, vehicle_yaw_rad: float, dt: float) -> None:
        """Move pitch and yaw towards the mode's target for dt seconds, within the limits and the
        slew rate.

        vehicle: its location; None if not known. vehicle_yaw_rad: heading from north. Does nothing
        without a configured mount.
        """
        if not self.fitted:
            return
        pitch, yaw = self._target(vehicle, vehicle_yaw_rad, dt)
        p = self.parameters
        pitch = min(max(pitch, radians(p["MNT1_PITCH_MIN"])), radians(p["MNT1_PITCH_MAX"]))
        yaw = min(max(yaw, radians(p["MNT1_YAW_MIN"])), radians(p["MNT1_YAW_MAX"]))
        step = _SLEW * dt
        self.pitch_rad += min(max(pitch - self.pitch_rad, -step), step)
        self.yaw_rad += min(max(yaw - self.yaw_rad, -step), step)

    def _target(
        self, vehicle: Location | None, vehicle_yaw_rad: float, dt: float
    ) -> tuple[float, float]:
        if self.mode is GimbalMode.RATE:
            self._wanted_pitch = self.pitch_rad + self._rates[0] * dt
            self._wanted_yaw = self.yaw_rad + self._rates[1] * dt
            return self._wanted_pitch, self._wanted_yaw
        if self.mode is GimbalMode.ANGLE:
            yaw = self._wanted_yaw - (vehicle_yaw_rad if self.yaw_locked else 0.0)
            return self._wanted_pitch, wrap_pi(yaw)
        if self.mode is GimbalMode.LOCATION and self._roi is not None and vehicle is not None:
            north, east, down = vehicle.ned_of(self._roi)
            return -atan2(down, hypot(north, east)), wrap_pi(atan2(east, north) - vehicle_yaw_rad)
        return radians(self.parameters["MNT1_NEUTRAL_Y"]), radians(
            self.parameters["MNT1_NEUTRAL_Z"]
        )
