"""ArduPilot logs of a made-up flight: .tlog and .bin, without an autopilot."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from localizer.geometry.pose import Array, matrix_from_euler, quaternion_from_matrix, so3_log

UTC_S = 1_533_430_800.0  # of the flight's begin
BOOT_S = 100.0  # since the autopilot's own
ORIGIN = (47.3, 8.5)
_METRE_DEG = 1.0 / 111_195.0

# (north m, east m, height m, roll, pitch, yaw rad) at seconds from the begin.
Motion = Callable[[float], tuple[float, float, float, float, float, float]]


def swaying(t: float) -> tuple[float, float, float, float, float, float]:
    """Ahead to the north, turning and rolling as a small aircraft does."""
    roll, yaw = 0.15 * math.sin(0.9 * t), 0.3 * math.sin(0.5 * t)
    return 8.0 * t, 6.0 * math.sin(0.3 * t), 80.0, roll, 0.0, yaw


def place(north_m: float, east_m: float, origin: tuple[float, ...] = ORIGIN) -> tuple[float, float]:
    """Latitude and longitude, degrees."""
    shrink = math.cos(math.radians(origin[0]))
    return origin[0] + north_m * _METRE_DEG, origin[1] + east_m * _METRE_DEG / shrink


def sensed(motion: Motion, t: float) -> tuple[Array, Array]:
    """Specific force, m/s^2, and turn rate, rad/s, (3,) in the body's axes."""
    h = 0.02
    before, now, after = (np.array(motion(t + dt)) for dt in (-h, 0.0, h))
    up = np.array([1.0, 1.0, -1.0])  # the motion has heights
    force = up * (before - 2.0 * now + after)[:3] / h**2 - np.array([0.0, 0.0, 9.80665])
    R, S, T = (matrix_from_euler(*m[3:]) for m in (now, before, after))
    return R.T @ force, so3_log(S.T @ T) / (2.0 * h)


def write_tlog(
    path: Path, motion: Motion, seconds: float, gimbal_pitch_deg: float | None = None
) -> Path:
    """Attitude at 10 Hz, position at 5 Hz; gimbal_pitch_deg: MOUNT_STATUS beside them."""
    codec, frames = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), []

    def send(t: float, message: mavlink.MAVLink_message) -> None:
        frames.append(struct.pack(">Q", round((UTC_S + t) * 1e6)) + message.pack(codec))

    for step in range(round(seconds * 10)):
        t = step / 10.0
        north, east, height, roll, pitch, yaw = motion(t)
        ms = round((BOOT_S + t) * 1000)
        if step % 10 == 0:
            send(t, mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
        send(t, mavlink.MAVLink_attitude_message(ms, roll, pitch, yaw, 0, 0, 0))
        if step % 2 == 0:
            latitude, longitude = place(north, east)
            send(t, mavlink.MAVLink_global_position_int_message(
                ms, round(latitude * 1e7), round(longitude * 1e7), round((500 + height) * 1000),
                round(height * 1000), 0, 0, 0, 0))  # fmt: skip
        if gimbal_pitch_deg is not None:
            hundredths = round(gimbal_pitch_deg * 100)
            send(t, mavlink.MAVLink_mount_status_message(1, 1, hundredths, 0, 0))
    path.write_bytes(b"".join(frames))
    return path


_HEAD = b"\xa3\x95"
_ROWS = {  # name: (type, format, columns)
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "GPS": (130, "QBIHBcLLefffB", "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,U"),
    "POS": (131, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": (132, "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "MNT": (133, "QBffffff", "TimeUS,I,DesRoll,Roll,DesPitch,Pitch,DesYawB,YawB"),
    "XKF1": (135, "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD"),
    "IMU": (136, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "ARM": (137, "QB", "TimeUS,ArmState"),
    "CAM": (134, "QBHIHLLeeeccC", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y"),
    "TRIG": (138, "QBHIHLLeeeccC", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y"),
}
_CODES = {"Q": "Q", "B": "B", "I": "I", "H": "H", "c": "h", "C": "H", "L": "i", "e": "i",
          "f": "f", "n": "4s", "N": "16s", "Z": "64s"}  # fmt: skip
_WEEK_S = 604_800.0
_GPS_EPOCH_S, _LEAP_S = 315_964_800.0, 18.0


def write_dataflash(
    path: Path, motion: Motion, seconds: float, gimbal_pitch_deg: float | None = None,
    origin: tuple[float, float, float] = (*ORIGIN, 500.0), exposures: Sequence[float] = (),
) -> Path:  # fmt: skip
    """The same flight as a .bin. origin: latitude, longitude, AMSL; exposures: seconds of CAM, each
    with its TRIG 0.2 s before.
    """
    body = b"".join(_format(name) for name in _ROWS) + _row("ARM", round(BOOT_S * 1e6), 1)
    gps_s = UTC_S - _GPS_EPOCH_S + _LEAP_S
    for step in range(round(seconds * 10)):
        t = step / 10.0
        north, east, height, roll, pitch, yaw = motion(t)
        us, (latitude, longitude) = round((BOOT_S + t) * 1e6), place(north, east, origin)
        lat, lng = round(latitude * 1e7), round(longitude * 1e7)
        if step % 2 == 0:
            week, second = divmod(gps_s + t, _WEEK_S)
            body += _row("GPS", us, 3, round(second * 1000), int(week), 14, 80, lat, lng,
                         round((origin[2] + height) * 100), 8.0, 0.0, 0.0, 1)  # fmt: skip
            body += _row("POS", us, lat, lng, origin[2] + height, height, height)
        ahead = motion(t + 0.05)
        speed = [20.0 * (b - a) for a, b in zip((north, east, height), ahead, strict=False)]
        body += _row("XKF1", us, 0, *speed[:2], -speed[2], north, east, -height)
        for part in (0.0, 0.05):
            force, rates = sensed(motion, t + part)
            body += _row("IMU", us + round(part * 1e6), 0, *rates, *force)
        degrees = [round(math.degrees(a) * 100) for a in (roll, pitch)]
        turn = round(math.degrees(yaw) * 100) % 36000
        body += _row("ATT", us, 0, degrees[0], 0, degrees[1], turn, turn)
        if gimbal_pitch_deg is not None:
            body += _row("MNT", us, 0, 0.0, 0.0, 0.0, gimbal_pitch_deg, 0.0, 0.0)
    for number, t in enumerate(exposures):
        north, east, height, roll, pitch, yaw = motion(t)
        at = [round(1e7 * degrees) for degrees in place(north, east, origin)]
        up = [round(100 * metres) for metres in (origin[2] + height, height, origin[2] + height)]
        angles = [round(math.degrees(a) * 100) for a in (roll, pitch, yaw)]
        for name, when in (("TRIG", t - 0.2), ("CAM", t)):
            us = round((BOOT_S + when) * 1e6)
            body += _row(name, us, 0, number, 0, 0, *at, *up, *angles[:2], angles[2] % 36000)
    path.write_bytes(body)
    return path


def _format(name: str) -> bytes:
    number, kinds, columns = _ROWS[name]
    length = 3 + struct.calcsize("<" + "".join(_CODES[k] for k in kinds))
    return _row("FMT", number, length, name.encode(), kinds.encode(), columns.encode())


def _row(name: str, *values: object) -> bytes:
    number, kinds, _ = _ROWS[name]
    return _HEAD + bytes((number,)) + struct.pack("<" + "".join(_CODES[k] for k in kinds), *values)


_TOPICS = {
    "vehicle_status": "uint8_t arming_state;uint8_t system_type;",
    "vehicle_attitude": "float[4] q;",
    "vehicle_global_position": "double lat;double lon;float alt;",
    "vehicle_gps_position": "uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;float eph;uint8_t fix_type;uint8_t satellites_used;",
    "home_position": "float alt;",
}


def write_ulog(path: Path, motion: Motion, seconds: float) -> Path:
    """The same flight as PX4 logs it, without a gimbal."""
    body = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    for name, fields in _TOPICS.items():
        body += _chunk("F", f"{name}:uint64_t timestamp;{fields}".encode())
    for number, name in enumerate(_TOPICS):
        body += _chunk("A", struct.pack("<BH", 0, number) + name.encode())
    for step in range(round(seconds * 10)):
        t = step / 10.0
        north, east, height, *angles = motion(t)
        us, (latitude, longitude) = round((BOOT_S + t) * 1e6), place(north, east)
        utc_us = round((UTC_S + t) * 1e6)
        q = quaternion_from_matrix(matrix_from_euler(*angles))
        for number, row in enumerate((
            struct.pack("<BB", 2, 2), struct.pack("<4f", *q),
            struct.pack("<ddf", latitude, longitude, 500 + height),
            struct.pack("<QdddfBB", utc_us, latitude, longitude, 500 + height, 0.8, 3, 14),
            struct.pack("<f", 500),
        )):  # fmt: skip
            body += _chunk("D", struct.pack("<HQ", number, us) + row)
    path.write_bytes(body)
    return path


def _chunk(kind: str, body: bytes) -> bytes:
    return struct.pack("<Hc", len(body), kind.encode()) + body
