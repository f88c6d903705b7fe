"""Telemetry in a video: KLV packets of MPEG-TS (ST 0601, or EG 0104's universal set)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

from companion.errors import FootageError
from companion.geometry import GIMBAL_FROM_CAMERA
from companion.klv import local_set as tag
from companion.recorded.flight import (
    Datum,
    Height,
    RecordedPosition,
    RecordedView,
    Telemetry,
)
from localizer.geometry.pose import matrix_from_euler

_GNSS_M, _HEIGHT_M = 5.0, 10.0  # of what a sensor's metadata say; the standard has no accuracy here
_TILT_DEG, _HEADING_DEG = 1.0, 2.0

Fields = dict[int, float | str | int]


@dataclass(frozen=True)
class KlvTrack:
    """Telemetry of a video's KLV packets. samples: telemetry by time from the first frame, ns;
    packets: number read; damaged: number not decoded; field_of_view_deg: horizontal, first value.
    """

    samples: tuple[Telemetry, ...]
    packets: int
    damaged: int
    field_of_view_deg: float | None


def read_klv_packets(path: Path) -> list[tuple[int, bytes]]:
    """Packets with their time from the first frame, ns, in file order. A packet without a time has
    that of the video packet before it. `FootageError` if the file is no video or damaged.
    """
    packets: list[tuple[int | None, bytes]] = []
    first: int | None = None
    try:
        with av.open(str(path)) as container:
            data = {s.index for s in container.streams if s.type == "data"}
            if not data:
                return []
            now: int | None = None
            for packet in container.demux():
                if packet.stream.type == "video" and packet.pts is not None:
                    now = _nanoseconds(packet)
                    first = now if first is None else min(first, now)
                elif packet.stream.index in data and packet.size:
                    own = _nanoseconds(packet) if packet.pts is not None else now
                    packets.append((own, bytes(packet)))
    except av.error.FFmpegError as error:
        raise FootageError(f"{path}: not a video, or damaged: {error}") from error
    begin = first or 0
    return [(0 if time is None else time - begin, body) for time, body in packets]


def read_klv(path: Path) -> KlvTrack:
    """Telemetry of a video's KLV packets, in their order in the file (`read_klv_packets`). Packets
    without a position give no sample; `packets` includes the damaged ones.
    """
    samples, damaged, packets, fov = [], 0, 0, None
    for time_ns, body in read_klv_packets(path):
        if body[:4] != tag.UNIVERSAL_LABEL[:4]:
            continue  # another kind of data
        packets += 1
        try:
            fields = decode(body)
        except ValueError:
            damaged += 1
            continue
        angle = fields.get(tag.HORIZONTAL_FOV)
        fov = fov or (float(angle) if isinstance(angle, float) and angle > 0.0 else None)
        samples.append(telemetry(fields, time_ns))
    return KlvTrack(tuple(s for s in samples if s.position), packets, damaged, fov)


def decode(packet: bytes) -> Fields:
    """Decode a packet of either standard to ST 0601 tags; ValueError for other packets."""
    if packet.startswith(tag.UNIVERSAL_SET_LABEL):
        return tag.decode_universal(packet)
    return tag.decode(packet)


def telemetry(fields: Fields, time_ns: int) -> Telemetry:
    """Position and camera direction of a packet's fields (`decode`), at time_ns; None for what they
    lack.
    """

    def number(name: int) -> float | None:
        value = fields.get(name)
        return float(value) if isinstance(value, int | float) else None

    latitude, longitude = number(tag.SENSOR_LATITUDE), number(tag.SENSOR_LONGITUDE)
    position = None
    if latitude is not None and longitude is not None and abs(latitude) <= 90.0:
        heights = [
            Height(value, datum, _HEIGHT_M)
            for name, datum in (
                (tag.SENSOR_HEIGHT, Datum.ELLIPSOID), (tag.SENSOR_ALTITUDE, Datum.AMSL)
            )
            if (value := number(name)) is not None
        ]  # fmt: skip
        position = RecordedPosition(latitude, longitude, _GNSS_M, tuple(heights))
    view = _view(
        [number(tag.PLATFORM_HEADING),
         _first(number(tag.PLATFORM_PITCH_FULL), number(tag.PLATFORM_PITCH)),
         _first(number(tag.PLATFORM_ROLL_FULL), number(tag.PLATFORM_ROLL))],
        [number(tag.RELATIVE_AZIMUTH), number(tag.RELATIVE_ELEVATION), number(tag.RELATIVE_ROLL)],
    )  # fmt: skip
    if view is None:
        view = _universal_view(
            number(tag.ANGLE_TO_NORTH), number(tag.OBLIQUITY),
            number(tag.RELATIVE_ROLL),
        )  # fmt: skip
    return Telemetry(time_ns, position, view, number(tag.PLATFORM_HEADING))


def _first(*values: float | None) -> float | None:
    return next((v for v in values if v is not None), None)


def _view(platform: list[float | None], sensor: list[float | None]) -> RecordedView | None:
    """Direction by the platform's heading, pitch, roll and the sensor's azimuth,
    elevation, roll.
    """
    if sensor[2] is None:
        sensor = [*sensor[:2], 0.0]
    told = [math.radians(a) for a in (*platform, *sensor) if a is not None]
    if len(told) != 6:
        return None
    yaw, pitch, roll, azimuth, elevation, turn = told
    on_body = matrix_from_euler(turn, elevation, azimuth)
    to_ned = matrix_from_euler(roll, pitch, yaw) @ on_body @ GIMBAL_FROM_CAMERA
    return RecordedView(np.asarray(to_ned), _TILT_DEG, _HEADING_DEG)


def _universal_view(
    north: float | None, obliquity: float | None, roll: float | None
) -> RecordedView | None:
    """Camera direction by EG 0104's angles, which are against north and the horizon. Obliquity is
    written as a negative elevation, or with 180 ahead and 270 down.
    """
    if north is None or obliquity is None:
        return None
    pitch = 180.0 - obliquity if obliquity > 90.0 else -abs(obliquity)
    return RecordedView.of_angles(roll or 0.0, pitch, north, _TILT_DEG, _HEADING_DEG)


def _nanoseconds(packet: av.Packet) -> int:
    return round(1e9 * float(packet.pts * packet.time_base))
