"""ArduPilot's logs beside video or photos: .bin (the dataflash log) and .tlog (MAVLink).

Position by the EKF, attitude of the body, and the camera's view: a gimbal's where one reports, else
that of a camera which is fixed to the body.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink import DFReader

from companion.errors import FootageError
from companion.geometry import (
    GimbalAngles,
    GimbalFrame,
    Mount,
    camera_attitude,
)
from companion.recorded.flight import (
    Datum,
    Height,
    RecordedPosition,
    RecordedView,
    Telemetry,
    Track,
)
from localizer.geometry.pose import euler_from_matrix, matrix_from_euler, matrix_from_quaternion
from mavlink_bridge.errors import BridgeError
from mavlink_bridge.link.clock import BootClock
from mavlink_bridge.link.tlog import read_tlog

LOG_SUFFIXES = frozenset({".bin", ".log", ".tlog"})
_GNSS_M, _AMSL_M, _TAKEOFF_M = 2.0, 5.0, 2.0
_TILT_DEG, _HEADING_DEG = 1.0, 5.0
_FIXED_TILT_DEG = 3.0  # how well a camera is screwed on
_STEP_S = 0.1  # of the samples that are made
_GIMBAL_AGE_S = 1.0


@dataclass(frozen=True)
class LogTrack:
    """What a log says. track: UTC nanoseconds; triggers_ns: of camera feedback (CAM, TRIG), UTC;
    has_gimbal: whether a gimbal's angles are in it; notes: what was assumed.
    """

    track: Track
    triggers_ns: tuple[int, ...]
    has_gimbal: bool
    notes: tuple[str, ...]


@dataclass
class _Raw:
    """Rows of a log by kind, each with UTC nanoseconds first."""

    positions: list[tuple[int, float, float, float, float | None]]
    attitudes: list[tuple[int, float, float, float]]
    gimbals: list[tuple[int, GimbalAngles]]
    triggers: list[int]


def read_autopilot_log(path: Path, fixed_pitch_deg: float = -90.0) -> LogTrack:
    """A log's telemetry. fixed_pitch_deg: of a camera on the body, where no gimbal reports.

    `FootageError` where the log lacks positions or attitudes, or is none.
    """
    if path.suffix.lower() == ".ulg":
        raise FootageError(f"{path}: PX4's logs are not read; give the .tlog of the ground station")
    try:
        raw = _read_tlog(path) if path.suffix.lower() == ".tlog" else _read_dataflash(path)
    except (OSError, BridgeError, ValueError, TypeError, AttributeError, IndexError) as error:
        raise FootageError(f"{path}: not an ArduPilot log that can be read: {error}") from error
    for rows, what in ((raw.positions, "position"), (raw.attitudes, "attitude")):
        if len(rows) < 2:
            raise FootageError(f"{path}: holds no {what} of the vehicle; is the log complete?")
    samples = tuple(_samples(raw, fixed_pitch_deg))
    if not samples:
        raise FootageError(f"{path}: its positions and attitudes are of different times")
    notes = []
    if not raw.gimbals:
        notes.append(
            f"{path.name} has no gimbal's angles: the camera is taken as fixed to the airframe, "
            f"pitch {fixed_pitch_deg:g} degrees"
        )
    return LogTrack(Track(samples), tuple(sorted(raw.triggers)), bool(raw.gimbals), tuple(notes))


def _samples(raw: _Raw, fixed_pitch_deg: float) -> Iterator[Telemetry]:
    positions = Track([_position(*row) for row in raw.positions])
    times = np.array([row[0] for row in raw.attitudes], dtype=np.int64)
    angles = np.unwrap(np.array([row[1:] for row in raw.attitudes]), axis=0)
    gimbal_times = np.array([g[0] for g in raw.gimbals], dtype=np.int64)
    begin = max(int(positions.times_ns[0]), int(times[0]))
    end = min(int(positions.times_ns[-1]), int(times[-1]))
    for time_ns in range(begin, end + 1, round(1e9 * _STEP_S)):
        where = positions.at(time_ns)
        if where is None:
            continue
        # Times of 1e18 ns do not fit a float: relative ones do.
        since = (times - times[0]).astype(np.float64)
        roll, pitch, yaw = (
            float(np.interp(float(time_ns - int(times[0])), since, angles[:, k])) for k in range(3)
        )
        body = np.asarray(matrix_from_euler(roll, pitch, yaw))
        gimbal, tilt = _gimbal(raw, gimbal_times, time_ns), _TILT_DEG
        if gimbal is None and len(gimbal_times):
            continue
        if gimbal is None:
            gimbal = GimbalAngles(0.0, math.radians(fixed_pitch_deg), 0.0, GimbalFrame.BODY)
            tilt = _FIXED_TILT_DEG
        attitude = camera_attitude(body, gimbal, Mount.from_degrees())
        view = RecordedView(attitude, tilt, _HEADING_DEG)
        yield replace(where, time_ns=time_ns, view=view, course_deg=math.degrees(yaw) % 360.0)


def _gimbal(raw: _Raw, times: np.ndarray, time_ns: int) -> GimbalAngles | None:
    if not len(times):
        return None
    near = int(np.argmin(np.abs(times - time_ns)))
    return raw.gimbals[near][1] if abs(int(times[near]) - time_ns) < 1e9 * _GIMBAL_AGE_S else None


def _position(
    time_ns: int, latitude: float, longitude: float, amsl: float, above: float | None
) -> Telemetry:
    heights = [Height(amsl, Datum.AMSL, _AMSL_M)]
    if above is not None:
        heights.append(Height(above, Datum.TAKEOFF, _TAKEOFF_M))
    return Telemetry(time_ns, RecordedPosition(latitude, longitude, _GNSS_M, tuple(heights)))


def _read_tlog(path: Path) -> _Raw:
    raw, clock = _Raw([], [], [], []), BootClock()
    vehicle: int | None = None
    for received_ns, message in read_tlog(path):
        kind = message.get_type()
        if vehicle is None and kind == "HEARTBEAT" and message.autopilot != 8:
            vehicle = message.get_srcSystem()
        if vehicle is not None and message.get_srcSystem() != vehicle:
            continue
        boot_ms = getattr(message, "time_boot_ms", None)
        time_ns = received_ns
        if boot_ms is not None:
            clock.observe(int(boot_ms) * 1_000_000, received_ns)
            time_ns = clock.to_monotonic(int(boot_ms) * 1_000_000, received_ns)
        _take_mavlink(raw, kind, message, time_ns)
    return raw


def _take_mavlink(raw: _Raw, kind: str, m: Any, time_ns: int) -> None:
    if kind == "GLOBAL_POSITION_INT" and (m.lat or m.lon):
        raw.positions.append(
            (time_ns, m.lat * 1e-7, m.lon * 1e-7, m.alt * 1e-3, m.relative_alt * 1e-3)
        )
    elif kind == "ATTITUDE":
        raw.attitudes.append((time_ns, m.roll, m.pitch, m.yaw))
    elif kind == "MOUNT_STATUS":  # hundredths of degrees: a pitch, b roll, c yaw
        pitch, roll, yaw = (
            math.radians(x * 0.01) for x in (m.pointing_a, m.pointing_b, m.pointing_c)
        )
        raw.gimbals.append((time_ns, GimbalAngles(roll, pitch, yaw, GimbalFrame.HEADING)))
    elif kind == "MOUNT_ORIENTATION":
        roll, pitch, yaw = (math.radians(x) for x in (m.roll, m.pitch, m.yaw))
        raw.gimbals.append((time_ns, GimbalAngles(roll, pitch, yaw, GimbalFrame.HEADING)))
    elif kind == "GIMBAL_DEVICE_ATTITUDE_STATUS":
        earth = bool(m.flags & 64)  # GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
        frame = GimbalFrame.EARTH if earth else GimbalFrame.HEADING
        raw.gimbals.append((time_ns, GimbalAngles(*_euler(m.q), frame)))
    elif kind == "CAMERA_FEEDBACK":
        raw.triggers.append(int(m.time_usec) * 1000)


def _euler(q: Sequence[float]) -> tuple[float, float, float]:
    return euler_from_matrix(matrix_from_quaternion(q))


def _read_dataflash(path: Path) -> _Raw:
    reader: Any = (
        DFReader.DFReader_text(str(path))
        if path.suffix.lower() == ".log"
        else DFReader.DFReader_binary(str(path))
    )
    raw = _Raw([], [], [], [])
    kinds = ["POS", "ATT", "MNT", "CAM", "TRIG"]
    while (m := reader.recv_match(type=kinds)) is not None:
        # The clock's base is UTC by the log's own GPS messages, or 0: seconds since boot.
        time_ns, kind = round(1e9 * reader.clock.timebase) + int(m.TimeUS) * 1000, m.get_type()
        if kind == "POS":
            raw.positions.append((time_ns, m.Lat, m.Lng, m.Alt, getattr(m, "RelHomeAlt", None)))
        elif kind == "ATT":
            raw.attitudes.append((time_ns, *(math.radians(x) for x in (m.Roll, m.Pitch, m.Yaw))))
        elif kind == "MNT":
            raw.gimbals.append((time_ns, _logged_gimbal(m)))
        else:
            raw.triggers.append(time_ns)
    return raw


def _logged_gimbal(m: Any) -> GimbalAngles:
    """MNT's angles, degrees; YawE is against north, Yaw or YawB against the vehicle's heading."""
    earth = getattr(m, "YawE", math.nan)
    if not math.isnan(earth):
        yaw, frame = earth, GimbalFrame.EARTH
    else:
        yaw, frame = getattr(m, "YawB", getattr(m, "Yaw", 0.0)), GimbalFrame.HEADING
    roll, pitch = getattr(m, "Roll", 0.0), getattr(m, "Pitch", 0.0)
    return GimbalAngles(math.radians(roll), math.radians(pitch), math.radians(yaw), frame)
