"""Converts ArduPilot's dataflash log (.bin, .log) to MAVLink messages."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pymavlink import DFReader
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import FootageError
from companion.recorded.log_messages import (
    Dated,
    gimbal_message,
    imu_message,
    origin_message,
    position_message,
    pressure_message,
    range_message,
    receiver_message,
    sent_by_autopilot,
)

_HEAD = b"\xa3\x95"  # of every message
_SECOND_NS = 1_000_000_000
_ARMED, _DISARMED = 10, 11  # EV
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
        self.armed = m.Id == _ARMED or (self.armed and m.Id != _DISARMED)

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
