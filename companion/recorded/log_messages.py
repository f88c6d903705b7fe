"""Makes MAVLink messages from log rows, as the vehicle would have sent them. ms, us: since boot."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from localizer.geometry.pose import matrix_from_euler, quaternion_from_matrix

Dated = tuple[int, Any]
"""UTC in ns (since boot, where the log knows no UTC), and a MAVLink message."""


def sent_by_autopilot(time_ns: int, message: Any) -> Iterator[Dated]:
    """Yield the message as sent by 1/1 at time_ns; nothing if its values do not fit the fields."""
    try:
        message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
    except (struct.error, OverflowError, ValueError):
        return
    yield time_ns, message


def position_message(ms: int, at_deg: tuple[float, float], amsl_m: float, above_m: float) -> Any:
    """GLOBAL_POSITION_INT. at_deg: latitude, longitude; above_m: height above take-off."""
    latitude, longitude = (round(x * 1e7) for x in at_deg)
    return mavlink.MAVLink_global_position_int_message(
        ms, latitude, longitude, round(amsl_m * 1e3), round(above_m * 1e3), 0, 0, 0, 65535
    )


def receiver_message(
    us: int, fix: int, at_deg: tuple[float, float], amsl_m: float, satellites: int,
    accuracy_m: float,
) -> Any:  # fmt: skip
    """GPS_RAW_INT. fix: GPS_FIX_TYPE; accuracy_m: horizontal, 0 if unknown."""
    latitude, longitude = (round(x * 1e7) for x in at_deg)
    return mavlink.MAVLink_gps_raw_int_message(
        us, min(fix, 8), latitude, longitude, round(amsl_m * 1e3), 65535, 65535, 65535, 65535,
        min(satellites, 254), h_acc=round(accuracy_m * 1e3),
    )  # fmt: skip


def imu_message(us: int, force: tuple[float, ...], rates: tuple[float, ...]) -> Any:
    """HIGHRES_IMU: specific force m/s^2 and turn rate rad/s, body axes."""
    return mavlink.MAVLink_highres_imu_message(us, *force, *rates, 0, 0, 0, 0, 0, 0, 0, 63)


def pressure_message(ms: int, pascal: float) -> Any:
    """SCALED_PRESSURE. pascal: absolute pressure."""
    return mavlink.MAVLink_scaled_pressure_message(ms, pascal * 0.01, 0.0, 0)


def range_message(ms: int, metres: float, orientation: int) -> Any:
    """DISTANCE_SENSOR. orientation: MAV_SENSOR_ROTATION."""
    return mavlink.MAVLink_distance_sensor_message(
        ms, 1, 65535, min(max(round(metres * 100), 0), 65535), 0, 0, orientation, 255
    )


def origin_message(at_deg: tuple[float, float], amsl_m: float) -> Any:
    """GPS_GLOBAL_ORIGIN. at_deg: latitude, longitude."""
    latitude, longitude = (round(x * 1e7) for x in at_deg)
    return mavlink.MAVLink_gps_global_origin_message(latitude, longitude, round(amsl_m * 1e3))


def gimbal_message(ms: int, degrees: tuple[float, float, float], *, earth: bool) -> Any:
    """GIMBAL_DEVICE_ATTITUDE_STATUS of roll, pitch, yaw; earth: yaw from north, not the nose."""
    q = quaternion_from_matrix(matrix_from_euler(*(math.radians(x) for x in degrees)))
    frame = (
        mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
        if earth
        else mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
    )
    return mavlink.MAVLink_gimbal_device_attitude_status_message(
        0, 0, ms, frame, [float(x) for x in q], 0.0, 0.0, 0.0, 0
    )
