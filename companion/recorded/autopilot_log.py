"""Reads logs beside video or photos: ArduPilot's .bin (dataflash), MAVLink's .tlog and PX4's .ulg.

A log gives the EKF's position, the body's attitude, and the camera's direction: by the gimbal if
one reports, otherwise as of a camera fixed to the body.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

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
from companion.recorded.log_messages import Dated, dataflash_messages, ulog_messages
from localizer.geometry.pose import euler_from_matrix, matrix_from_euler, matrix_from_quaternion
from mavlink_bridge.errors import BridgeError
from mavlink_bridge.link.clock import BootClock
from mavlink_bridge.link.tlog import read_tlog
from mavlink_bridge.quaternion import normalise
from mavlink_bridge.vehicle.readings import (
    ANGLE_RAD,
    boot_time_ns,
    check_place,
    check_within,
    gimbal_in_earth_frame,
    is_autopilot,
)

LOG_SUFFIXES = frozenset({".bin", ".log", ".tlog", ".ulg"})
_GNSS_M, _AMSL_M, _TAKEOFF_M = 2.0, 5.0, 2.0
_TILT_DEG, _HEADING_DEG = 1.0, 5.0
_FIXED_TILT_DEG = 3.0  # how well a camera is screwed on
_STEP_S = 0.1  # of the samples that are made
_GIMBAL_AGE_S = 1.0
_LONGEST_NS = 30 * 86_400_000_000_000  # of one log: its samples would fill the memory


@dataclass(frozen=True)
class LogTrack:
    """Telemetry of a log. track: UTC nanoseconds; exposures: camera pose at each exposure message
    (CAM, else TRIG; CAMERA_FEEDBACK), in time order; has_gimbal: whether the log has gimbal angles;
    notes: assumptions.
    """

    track: Track
    exposures: tuple[Telemetry, ...]
    has_gimbal: bool
    notes: tuple[str, ...]


@dataclass
class _LogRows:
    """Rows of a log by kind, each with UTC nanoseconds first."""

    positions: list[tuple[int, float, float, float, float]]
    attitudes: list[tuple[int, float, float, float]]
    gimbals: list[tuple[int, GimbalAngles]]
    feedback: list[tuple[int, Any]]
    refused: int = 0  # that say no place or no rotation

    @cached_property
    def gimbal_times(self) -> np.ndarray:
        """(G,) int64, UTC ns of the gimbal rows; call it after all are read."""
        return np.array([g[0] for g in self.gimbals], dtype=np.int64)


def read_autopilot_log(path: Path, fixed_pitch_deg: float = -90.0) -> LogTrack:
    """Read a log's telemetry. fixed_pitch_deg: pitch of a camera on the body, used if no gimbal
    reports.

    `FootageError` if the file is no log, or has no positions or attitudes.
    """
    raw = _read(path)
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
    if raw.refused:
        notes.append(f"{path.name}: {raw.refused} rows say no place or no rotation: not used")
    track = Track(samples)
    exposures = tuple(_exposures(raw, track, fixed_pitch_deg))
    stamps = [time_ns for time_ns, _ in _exposures_of_first_camera(raw)]
    if len(exposures) > 1 and (len(set(stamps)) == 1 or stamps != sorted(stamps)):
        notes.append(
            f"{path.name}: the times of its exposures (CAM, TRIG) stand still or run back: not used"
        )
        exposures = ()
    return LogTrack(track, exposures, bool(raw.gimbals), tuple(notes))


def _exposures_of_first_camera(raw: _LogRows) -> list[tuple[int, Any]]:
    """The first camera's exposures, in the log's order; requests (TRIG) only if none is logged."""
    kinds = [(m.flags == mavlink.CAMERA_FEEDBACK_OPENLOOP, m.cam_idx) for _, m in raw.feedback]
    return [row for row, kind in zip(raw.feedback, kinds, strict=True) if kind == min(kinds)]


def _exposures(raw: _LogRows, track: Track, fixed_pitch_deg: float) -> Iterator[Telemetry]:
    """Camera poses at the exposures, without repeats: two links log each message twice."""
    rows = _exposures_of_first_camera(raw)
    told = {(m.time_usec, m.img_idx): (time_ns, m) for time_ns, m in reversed(rows)}
    for time_ns, m in sorted(told.values(), key=lambda one: one[0]):
        said = track.at(time_ns) or Telemetry()
        if m.lat or m.lng:
            own = _position(time_ns, m.lat * 1e-7, m.lng * 1e-7, m.alt_msl, m.alt_rel)
            said = replace(said, position=own.position)
        angles = [math.radians(a) for a in (m.roll, m.pitch, m.yaw)]
        if all(map(math.isfinite, angles)):
            view = _view(raw, time_ns, angles, fixed_pitch_deg)
            said = replace(said, view=view, course_deg=m.yaw % 360.0)
        yield replace(said, time_ns=time_ns)


def _samples(raw: _LogRows, fixed_pitch_deg: float) -> Iterator[Telemetry]:
    positions = Track([_position(*row) for row in raw.positions])
    times = np.array([row[0] for row in raw.attitudes], dtype=np.int64)
    angles = np.unwrap(np.array([row[1:] for row in raw.attitudes]), axis=0)
    begin = max(int(positions.times_ns[0]), int(times[0]))
    end = min(int(positions.times_ns[-1]), int(times[-1]))
    since = (times - times[0]).astype(np.float64)  # times of 1e18 ns do not fit a float
    for time_ns in range(begin, end + 1, round(1e9 * _STEP_S)):
        where = positions.at(time_ns)
        if where is None:
            continue
        at = float(time_ns - int(times[0]))
        now = [float(np.interp(at, since, angles[:, k])) for k in range(3)]
        view = _view(raw, time_ns, now, fixed_pitch_deg)
        if view is not None:
            course_deg = math.degrees(now[2]) % 360.0
            yield replace(where, time_ns=time_ns, view=view, course_deg=course_deg)


def _view(
    raw: _LogRows, time_ns: int, body_rad: Sequence[float], fixed_pitch_deg: float
) -> RecordedView | None:
    """Camera direction; None while the log's gimbal is silent. body_rad: roll, pitch, yaw."""
    gimbal, tilt = _gimbal(raw, time_ns), _TILT_DEG
    if gimbal is None and raw.gimbals:
        return None
    if gimbal is None:
        gimbal = GimbalAngles(0.0, math.radians(fixed_pitch_deg), 0.0, GimbalFrame.BODY)
        tilt = _FIXED_TILT_DEG
    body = np.asarray(matrix_from_euler(*body_rad))
    return RecordedView(camera_attitude(body, gimbal, Mount.from_degrees()), tilt, _HEADING_DEG)


def _gimbal(raw: _LogRows, time_ns: int) -> GimbalAngles | None:
    times = raw.gimbal_times
    if not len(times):
        return None
    near = int(np.argmin(np.abs(times - time_ns)))
    return raw.gimbals[near][1] if abs(int(times[near]) - time_ns) < 1e9 * _GIMBAL_AGE_S else None


def _position(
    time_ns: int, latitude: float, longitude: float, amsl: float, above: float
) -> Telemetry:
    heights = (Height(amsl, Datum.AMSL, _AMSL_M), Height(above, Datum.TAKEOFF, _TAKEOFF_M))
    known = tuple(h for h in heights if math.isfinite(h.value_m))
    return Telemetry(time_ns, RecordedPosition(latitude, longitude, _GNSS_M, known))


def vehicle_messages(path: Path) -> Iterator[Dated]:
    """Yield every MAVLink message of a log in order, dated; made from the rows of .bin and .ulg.

    `FootageError` if it is no log that can be read.
    """
    readers: dict[str, Callable[[Path], Iterator[Dated]]] = {
        ".tlog": read_tlog, ".ulg": ulog_messages
    }  # fmt: skip
    try:
        yield from readers.get(path.suffix.lower(), dataflash_messages)(path)
    except (OSError, BridgeError, ValueError, TypeError, AttributeError, IndexError) as error:
        raise FootageError(
            f"{path}: not a log of ArduPilot or PX4 that can be read: {error}"
        ) from error


def _read(path: Path) -> _LogRows:
    raw, clock = _LogRows([], [], [], []), BootClock()
    vehicle: int | None = None
    first_ns: int | None = None
    for received_ns, message in vehicle_messages(path):
        kind = message.get_type()
        if vehicle is None and is_autopilot(message):
            vehicle = message.get_srcSystem()
        if vehicle is not None and message.get_srcSystem() != vehicle:
            continue
        boot_ns, time_ns = boot_time_ns(message), received_ns
        if boot_ns is not None:
            clock.observe(boot_ns, received_ns)
            time_ns = clock.to_monotonic(boot_ns, received_ns)
        first_ns = received_ns if first_ns is None else first_ns
        if abs(time_ns - first_ns) > _LONGEST_NS or time_ns >= 1 << 63:
            raise FootageError(
                f"{path}: a {kind} is of {time_ns * 1e-9:.0f} s after 1970, its first row of "
                f"{first_ns * 1e-9:.0f} s: no times of one flight; is the log damaged?"
            )
        try:
            _take(raw, kind, message, time_ns)
        except ValueError:  # as in flight
            raw.refused += 1
    return raw


def _take(raw: _LogRows, kind: str, m: Any, time_ns: int) -> None:
    if kind == "GLOBAL_POSITION_INT" and (m.lat or m.lon):
        check_place(m.lat, m.lon)
        above_m = m.relative_alt * 1e-3
        raw.positions.append((time_ns, m.lat * 1e-7, m.lon * 1e-7, m.alt * 1e-3, above_m))
    elif kind == "ATTITUDE":
        check_within(ANGLE_RAD, m.roll, m.pitch, m.yaw)
        raw.attitudes.append((time_ns, m.roll, m.pitch, m.yaw))
    elif kind == "ATTITUDE_QUATERNION":
        raw.attitudes.append((time_ns, *_euler((m.q1, m.q2, m.q3, m.q4))))
    elif kind == "MOUNT_STATUS":  # hundredths of degrees: a pitch, b roll, c yaw
        pitch, roll, yaw = (
            math.radians(x * 0.01) for x in (m.pointing_a, m.pointing_b, m.pointing_c)
        )
        raw.gimbals.append((time_ns, GimbalAngles(roll, pitch, yaw, GimbalFrame.HEADING)))
    elif kind == "MOUNT_ORIENTATION":
        roll, pitch, yaw = (math.radians(x) for x in (m.roll, m.pitch, m.yaw))
        check_within(ANGLE_RAD, roll, pitch, yaw)
        raw.gimbals.append((time_ns, GimbalAngles(roll, pitch, yaw, GimbalFrame.HEADING)))
    elif kind == "GIMBAL_DEVICE_ATTITUDE_STATUS":
        frame = GimbalFrame.EARTH if gimbal_in_earth_frame(m.flags) else GimbalFrame.HEADING
        raw.gimbals.append((time_ns, GimbalAngles(*_euler(m.q), frame)))
    elif kind == "CAMERA_FEEDBACK":
        raw.feedback.append((time_ns, m))


def _euler(q: Sequence[float]) -> tuple[float, float, float]:
    return euler_from_matrix(matrix_from_quaternion(normalise(tuple(q))))
