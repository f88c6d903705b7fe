"""Converts PX4's log (.ulg) to MAVLink messages. Needs the extra ``ulog``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import FootageError
from companion.recorded.log_messages import (
    Dated,
    imu_message,
    position_message,
    pressure_message,
    range_message,
    receiver_message,
    sent_by_autopilot,
)

_PX4, _ARMED = 12, 2
_LONGEST_STEP_US = 20_000  # 50 Hz are enough: topics come with up to 250 Hz

Row = Mapping[str, Any]


def ulog_messages(path: Path) -> Iterator[Dated]:
    """Yield the MAVLink messages that correspond to the rows of a PX4 log (.ulg), in the order of
    their times (UTC). `FootageError` without `pyulog`, or if the file is not such a log.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise FootageError(
            f"{path}: PX4's logs are read by pyulog, which is not installed: pip install "
            "'pilot-companion[ulog]'; or give the .tlog of the ground station"
        ) from error
    try:
        log = ULog(str(path), list(_TOPICS))
    except Exception as error:  # pyulog has no error of its own: TypeError, KeyError, struct.error
        raise FootageError(f"{path}: not a log that pyulog reads: {error!r}") from error
    topics = {d.name: d.data for d in reversed(log.data_list) if len(d.data["timestamp"])}
    utc_us = _utc_less_boot_us(topics)
    home = topics.get("home_position", topics.get("vehicle_global_position", {})).get("alt", [0.0])
    rows: list[tuple[int, str, int]] = []
    for name, data in topics.items():
        rows.extend((int(data["timestamp"][k]), name, k) for k in _subsampled(data["timestamp"]))
    for us, name, k in sorted(rows):
        row = {field: values[k] for field, values in topics[name].items()}
        message = _TOPICS[name](row, us, float(home[0]))
        if message is not None:
            yield from sent_by_autopilot((us + utc_us) * 1000, message)


def _subsampled(times_us: np.ndarray) -> np.ndarray:
    """Indices of the samples used, about one each `_LONGEST_STEP_US`."""
    slot = np.asarray(times_us, np.int64) // _LONGEST_STEP_US
    return np.flatnonzero(np.diff(slot, prepend=-1) != 0)


def _utc_less_boot_us(topics: Mapping[str, Row]) -> int:
    receiver = topics.get("vehicle_gps_position", {})
    known = np.flatnonzero(receiver.get("time_utc_usec", np.zeros(0)))
    if not len(known):
        return 0
    k = int(known[0])
    return int(receiver["time_utc_usec"][k]) - int(receiver["timestamp"][k])


def _vector(row: Row, name: str, count: int = 3) -> tuple[float, ...]:
    return tuple(float(row[f"{name}[{k}]"]) for k in range(count))


def _status(row: Row, _us: int, _home_m: float) -> Any:
    armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if row["arming_state"] == _ARMED else 0
    kind = int(row.get("system_type", mavlink.MAV_TYPE_QUADROTOR))
    return mavlink.MAVLink_heartbeat_message(kind, _PX4, armed, 0, 4, 3)


def _attitude(row: Row, us: int, _home_m: float) -> Any:
    q = _vector(row, "q", 4)
    return mavlink.MAVLink_attitude_quaternion_message(us // 1000, *q, 0.0, 0.0, 0.0)


def _place(row: Row, us: int, home_m: float) -> Any:
    alt_m = float(row["alt"])
    return position_message(us // 1000, (row["lat"], row["lon"]), alt_m, alt_m - home_m)


def _local(row: Row, us: int, _home_m: float) -> Any:
    values = (float(row[name]) for name in ("x", "y", "z", "vx", "vy", "vz"))
    return mavlink.MAVLink_local_position_ned_message(us // 1000, *values)


def _receiver(row: Row, us: int, _home_m: float) -> Any:
    if "latitude_deg" in row:  # since PX4 1.14
        at, alt_m = (row["latitude_deg"], row["longitude_deg"]), row["altitude_msl_m"]
    else:
        at, alt_m = (row["lat"] * 1e-7, row["lon"] * 1e-7), row["alt"] * 1e-3
    accuracy_m = float(row["eph"]) if math.isfinite(row["eph"]) else 0.0
    return receiver_message(
        us, int(row["fix_type"]), at, float(alt_m), int(row["satellites_used"]), accuracy_m
    )


def _imu(row: Row, us: int, _home_m: float) -> Any:
    return imu_message(us, _vector(row, "accelerometer_m_s2"), _vector(row, "gyro_rad"))


def _pressure(row: Row, us: int, _home_m: float) -> Any:
    return pressure_message(us // 1000, float(row["baro_pressure_pa"]))


def _range(row: Row, us: int, _home_m: float) -> Any:
    return range_message(us // 1000, float(row["current_distance"]), int(row["orientation"]))


def _gimbal(row: Row, us: int, _home_m: float) -> Any:
    return mavlink.MAVLink_gimbal_device_attitude_status_message(
        0, 0, us // 1000, int(row["device_flags"]), _vector(row, "q", 4), 0.0, 0.0, 0.0, 0
    )


_TOPICS: dict[str, Callable[[Row, int, float], Any]] = {
    "vehicle_status": _status, "vehicle_attitude": _attitude, "vehicle_global_position": _place,
    "vehicle_local_position": _local, "vehicle_gps_position": _receiver, "sensor_combined": _imu,
    "vehicle_air_data": _pressure, "distance_sensor": _range,
    "gimbal_device_attitude_status": _gimbal, "home_position": lambda _row, _us, _home_m: None,
}  # fmt: skip
