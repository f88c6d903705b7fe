"""Makes MAVLink messages from ArduPilot's .bin and PX4's .ulg, as the vehicle sent them."""

from __future__ import annotations

import contextlib
import math
import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import DFReader
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import FootageError
from localizer.geometry.pose import matrix_from_euler, quaternion_from_matrix

_HEAD = b"\xa3\x95"  # of every message
_SECOND_NS = 1_000_000_000
_ARM_EVENTS, _DISARMED = 10, 11  # EV
_ARMED_FLAG = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
_KINDS = {"ArduCopter": 2, "ArduPlane": 1, "ArduRover": 10, "ArduSub": 12}  # MAV_TYPE


def dataflash_messages(path: Path) -> Iterator[Dated]:
    """Yield the messages of a .bin or .log with their times. `FootageError` for another file; other
    errors are those of pymavlink's reader.
    """
    is_text = path.suffix.lower() == ".log"
    with path.open("rb") as file:
        head = file.read(2)
    if not is_text and head != _HEAD:
        begins = f"begins with {head.hex(' ')}" if head else "is empty"
        raise FootageError(f"{path}: {begins}, no DataFlash log; copy it from the card again")
    # The reader prints a line for each byte that it skips.
    with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stderr(nowhere):
        reader: Any = (
            DFReader.DFReader_text(str(path)) if is_text else DFReader.DFReader_binary(str(path))
        )
    log = _Dataflash()
    while (row := reader.recv_match(type=list(_ROWS))) is not None:
        # The clock's base is UTC by the log's own GPS messages, or 0: seconds since boot.
        time_ns = round(1e9 * reader.clock.timebase) + int(row.TimeUS) * 1000
        ms = int(row.TimeUS) // 1000
        if time_ns - log.heartbeat_ns >= _SECOND_NS:
            log.heartbeat_ns = time_ns
            yield from sent_by_autopilot(time_ns, log.heartbeat())
        message = _ROWS[row.get_type()](log, row, ms)
        if message is not None:
            yield from sent_by_autopilot(time_ns, message)


@dataclass
class _Dataflash:
    """Converts rows to messages; keeps values of rows that other rows' messages need.

    Above 15 public methods: one of a few lines for each kind of row.
    """

    heartbeat_ns: int = -_SECOND_NS
    armed: bool = False
    mode: int = 0
    kind: int = mavlink.MAV_TYPE_QUADROTOR
    accuracy_m: float = 0.0
    begun_m: float | None = None
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def heartbeat(self) -> Any:
        base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (_ARMED_FLAG if self.armed else 0)
        return mavlink.MAVLink_heartbeat_message(self.kind, 3, base, self.mode, 4, 3)

    def mode_row(self, m: Any, _: int) -> None:
        self.mode = int(getattr(m, "ModeNum", 0))

    def arm_row(self, m: Any, _: int) -> None:
        self.armed = bool(m.ArmState)

    def event_row(self, m: Any, _: int) -> None:
        self.armed = m.Id == _ARM_EVENTS or (self.armed and m.Id != _DISARMED)

    def accuracy_row(self, m: Any, _: int) -> None:
        self.accuracy_m = float(m.HAcc)

    def text_row(self, m: Any, _: int) -> Any:
        said = re.match(r"(\w+) V(\d+)\.(\d+)\.(\d+)", str(m.Message))
        if said is None:
            return mavlink.MAVLink_statustext_message(6, str(m.Message)[:50].encode())
        self.kind = _KINDS.get(said[1], self.kind)
        version = int(said[2]) << 24 | int(said[3]) << 16 | int(said[4]) << 8 | 255
        nothing = bytes(8)
        return mavlink.MAVLink_autopilot_version_message(
            0, version, 0, 0, 0, nothing, nothing, nothing, 0, 0, 0
        )

    def attitude_row(self, m: Any, ms: int) -> Any:
        angles = (math.remainder(math.radians(x), math.tau) for x in (m.Roll, m.Pitch, m.Yaw))
        return mavlink.MAVLink_attitude_message(ms, *angles, *self.rates)

    def place_row(self, m: Any, ms: int) -> Any:
        if self.begun_m is None:  # logs of before 2016 say no height above home
            self.begun_m = m.Alt
        above_m = getattr(m, "RelHomeAlt", m.Alt - self.begun_m)
        return position_message(ms, (m.Lat, m.Lng), m.Alt, above_m)

    def local_row(self, m: Any, ms: int) -> Any:
        if getattr(m, "C", 0):  # of another core of the EKF
            return None
        values = (m.PN, m.PE, m.PD, m.VN, m.VE, m.VD)
        return mavlink.MAVLink_local_position_ned_message(ms, *values)

    def health_row(self, m: Any, _: int) -> Any:
        if getattr(m, "C", 0):
            return None
        # SS has the bits of EKF_STATUS_REPORT up to the predicted positions.
        flags = int(m.SS) & 0x3FF
        return mavlink.MAVLink_ekf_status_report_message(flags, m.SV, m.SP, m.SH, m.SM, 0.0)

    def receiver_row(self, m: Any, _: int) -> Any:
        if getattr(m, "I", 0):
            return None
        return receiver_message(
            int(m.TimeUS), int(m.Status), (m.Lat, m.Lng), m.Alt, int(m.NSats), self.accuracy_m
        )

    def imu_row(self, m: Any, _: int) -> Any:
        if getattr(m, "I", 0):
            return None
        self.rates = (m.GyrX, m.GyrY, m.GyrZ)
        return imu_message(int(m.TimeUS), (m.AccX, m.AccY, m.AccZ), self.rates)

    def pressure_row(self, m: Any, ms: int) -> Any:
        return None if getattr(m, "I", 0) else pressure_message(ms, m.Press)

    def range_row(self, m: Any, ms: int) -> Any:
        return range_message(ms, m.Dist, int(getattr(m, "Orient", 25)))

    def origin_row(self, m: Any, _: int) -> Any:
        if m.Type:  # 1: home
            return None
        return origin_message((m.Lat, m.Lng), m.Alt)

    def mount_row(self, m: Any, ms: int) -> Any:
        """Gimbal angles of MNT, degrees; YawE is against north, Yaw or YawB against the heading."""
        earth = getattr(m, "YawE", math.nan)
        yaw = getattr(m, "YawB", getattr(m, "Yaw", 0.0)) if math.isnan(earth) else earth
        angles = (getattr(m, "Roll", 0.0), getattr(m, "Pitch", 0.0), yaw)
        return gimbal_message(ms, angles, earth=not math.isnan(earth))

    def camera_row(self, m: Any, _: int) -> Any:
        """CAMERA_FEEDBACK of a CAM row (an exposure) or TRIG row (one was requested)."""
        flag = (
            mavlink.CAMERA_FEEDBACK_OPENLOOP
            if m.get_type() == "TRIG"
            else mavlink.CAMERA_FEEDBACK_PHOTO
        )
        at = (round(m.Lat * 1e7), round(m.Lng * 1e7), m.Alt, getattr(m, "RelAlt", math.nan))
        angles = (getattr(m, k[0], getattr(m, k, math.nan)) for k in ("Roll", "Pitch", "Yaw"))
        return mavlink.MAVLink_camera_feedback_message(
            int(m.TimeUS), 0, int(getattr(m, "I", 0)), int(getattr(m, "Img", 0)), *at, *angles,
            0.0, flag,
        )  # fmt: skip


_ROWS: dict[str, Callable[[_Dataflash, Any, int], Any]] = {
    "MODE": _Dataflash.mode_row, "ARM": _Dataflash.arm_row, "EV": _Dataflash.event_row,
    "MSG": _Dataflash.text_row, "ATT": _Dataflash.attitude_row, "POS": _Dataflash.place_row,
    "XKF1": _Dataflash.local_row, "NKF1": _Dataflash.local_row, "XKF4": _Dataflash.health_row,
    "NKF4": _Dataflash.health_row, "GPS": _Dataflash.receiver_row, "GPA": _Dataflash.accuracy_row,
    "IMU": _Dataflash.imu_row, "BARO": _Dataflash.pressure_row, "RFND": _Dataflash.range_row,
    "ORGN": _Dataflash.origin_row, "MNT": _Dataflash.mount_row, "CAM": _Dataflash.camera_row,
    "TRIG": _Dataflash.camera_row,
}  # fmt: skip


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
