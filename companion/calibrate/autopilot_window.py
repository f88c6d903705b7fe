"""The autopilot's data around each exposure, for any time offset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from companion.geometry import ned_from_world
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, matrix_from_quaternion, so3_log
from mavlink_bridge.messages import Attitude, GimbalAttitude

REACH_S = 0.4  # to both sides of the stamp: offsets beyond it are not looked for
_STEP_S = 0.02
OFFSETS_S: Array = np.arange(-REACH_S, REACH_S + 1e-9, _STEP_S)


class AutopilotRecord(Protocol):
    """A record's telemetry at any time; None if unknown."""

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """The vehicle's attitude at a CLOCK_MONOTONIC time."""
        ...

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """The camera's attitude to NED at a time."""
        ...

    def global_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's latitude, longitude and altitude AMSL at a time."""
        ...


@dataclass(frozen=True)
class AutopilotWindow:
    """Autopilot data around one timestamp, at T times `OFFSETS_S` from it; NaN if unknown.

    camera: (T, 3, 3) world from the camera's housing (gimbal axes, x along the boresight), without
    the deployment's mounting correction; body: (T, 3, 3) world from body; place: (T, 3) position by
    the EKF, map ENU, m.
    """

    camera: Array
    body: Array
    place: Array

    @property
    def has_place(self) -> bool:
        """Whether the EKF's position is known at all T times."""
        return bool(np.isfinite(self.place).all())

    def motion(self, offset_s: float = 0.0) -> tuple[Array, Array]:
        """Angular rate of the camera, rad/s, and the vehicle's velocity, m/s (0 if unknown), world
        axes (3,) each, at an offset within `REACH_S`; beyond it, at the window's end.
        """
        n = 3
        middle = round((offset_s + REACH_S) / _STEP_S)
        middle = min(max(middle, n), len(OFFSETS_S) - 1 - n)
        seconds = 2 * n * _STEP_S
        a, b = self.camera[middle - n], self.camera[middle + n]
        way = self.place[middle + n] - self.place[middle - n]
        return so3_log(b @ a.T) / seconds, np.nan_to_num(way / seconds)


def autopilot_window_at(
    autopilot: AutopilotRecord, time_ns: int, frame: LocalFrame, geoid_m: float, mount: Array
) -> AutopilotWindow | None:
    """The window around a timestamp; None if attitude or gimbal is unknown at one of its times.

    mount: (3, 3), the deployment's mounting angles. The angles of `gimbal_at` contain them already.
    """
    camera, body, place = [], [], []
    for offset_s in OFFSETS_S:
        t = time_ns + round(1e9 * offset_s)
        attitude, gimbal, where = (
            autopilot.attitude_at(t), autopilot.gimbal_at(t), autopilot.global_at(t)
        )  # fmt: skip
        if attitude is None or gimbal is None:
            return None
        if where is None:
            enu, to_ned = np.full(3, np.nan), ned_from_world(frame, frame.origin)
        else:
            enu = np.asarray(frame.enu_from_geodetic(where[0], where[1], where[2] + geoid_m))
            to_ned = ned_from_world(frame, frame.position(enu))
        camera.append(to_ned.T @ matrix_from_quaternion(gimbal.quaternion) @ mount.T)
        body.append(to_ned.T @ matrix_from_quaternion(attitude.quaternion))
        place.append(enu)
    return AutopilotWindow(np.array(camera), np.array(body), np.array(place))


def at_offset(values: Array, offset_s: float) -> Array:
    """Values (K, T, ...) of K timestamps at one offset, linearly interpolated: (K, ...). Beyond
    `REACH_S`, those of the window's end.
    """
    where = np.clip((offset_s + REACH_S) / _STEP_S, 0.0, len(OFFSETS_S) - 1.001)
    i = int(where)
    t = where - i
    between: Array = (1.0 - t) * values[:, i] + t * values[:, i + 1]
    return between
