"""The camera component: MAVLink camera protocol v2, tracking status, targets, Cursor-on-Target.

https://mavlink.io/en/services/camera.html . CAMERA_TRACKING_GEO_STATUS is the standard for a
target's coordinates; CAMERA_TRACKING_IMAGE_STATUS is what QGroundControl and Mission Planner draw;
ADSB_VEHICLE is what all three draw on the map (ground link only: ArduPilot ingests it as traffic).
"""

from __future__ import annotations

import math
from datetime import datetime, timedelta, timezone
from typing import Any
from xml.etree import ElementTree

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import CameraConfig, TargetsConfig
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.messages import CameraView, Origin, TargetReport, TrackRequest
from mavlink_bridge.vehicle.origin import north_east

NAN = math.nan
_INVALID_LATLON = 0x7FFFFFFF  # INT32_MAX: unknown coordinate, by the message's definition
_CAMERA_FLAGS = (
    mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
    | mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT
    | mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
    | mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS
)
_FIRMWARE = 1  # 0.0.0.1 as MAVLink packs it: (dev << 24) + (patch << 16) + (minor << 8) + major
_ADSB_FLAGS = (
    mavlink.ADSB_FLAGS_VALID_COORDS
    | mavlink.ADSB_FLAGS_VALID_ALTITUDE
    | mavlink.ADSB_FLAGS_VALID_CALLSIGN
)
_ICAO_BASE = 0xF00000  # unassigned block; the low bits carry the target's number
_COT_TYPE = "a-u-G"  # atom, unknown affiliation, ground
_TOLD_ELSEWHERE = 0.05  # from here on a target's other surface is worth a remark


def _text(value: str, length: int) -> list[int]:
    """A uint8[length] field, zero-terminated."""
    raw = value.encode("ascii", "replace")[: length - 1]
    return list(raw) + [0] * (length - len(raw))


def camera_information(config: CameraConfig, uptime_ms: int) -> Any:
    """CAMERA_INFORMATION (259) with the tracking flags; focal length and sensor size unknown."""
    return mavlink.MAVLink_camera_information_message(
        uptime_ms,
        _text(config.vendor, 32),
        _text(config.model, 32),
        _FIRMWARE,
        NAN,
        NAN,
        NAN,
        config.width_px,
        config.height_px,
        0,
        _CAMERA_FLAGS,
        0,
        b"",
    )


def video_stream_information(config: CameraConfig) -> Any:
    """VIDEO_STREAM_INFORMATION (269) of the one stream."""
    kind = mavlink.VIDEO_STREAM_TYPE_MPEG_TS
    if config.stream_uri.startswith("rtsp:"):
        kind = mavlink.VIDEO_STREAM_TYPE_RTSP
    return mavlink.MAVLink_video_stream_information_message(
        1,
        1,
        kind,
        mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING,
        0.0,
        config.width_px,
        config.height_px,
        0,
        0,
        round(config.horizontal_fov_deg),
        b"map camera",
        config.stream_uri.encode("ascii", "replace"),
    )


def tracking_image_status(report: TargetReport | None) -> Any:
    """CAMERA_TRACKING_IMAGE_STATUS (275): where the target is in the picture; None: idle."""
    if report is None or (report.pixel is None and report.rectangle is None):
        active, mode = mavlink.CAMERA_TRACKING_STATUS_FLAGS_IDLE, 0
        point, rectangle = (NAN, NAN), (NAN,) * 4
    elif report.rectangle is not None:
        active = mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
        mode, point, rectangle = (
            mavlink.CAMERA_TRACKING_MODE_RECTANGLE,
            (NAN, NAN),
            report.rectangle,
        )
    else:
        active = mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
        mode, rectangle = mavlink.CAMERA_TRACKING_MODE_POINT, (NAN,) * 4
        point = report.pixel or (NAN, NAN)
    return mavlink.MAVLink_camera_tracking_image_status_message(
        active,
        mode,
        mavlink.CAMERA_TRACKING_TARGET_DATA_IN_STATUS if mode else 0,
        *point,
        NAN,
        *rectangle,
    )


def tracking_geo_status(
    report: TargetReport, geoid_separation_m: float, camera: Origin | None
) -> Any:
    """CAMERA_TRACKING_GEO_STATUS (276): the target's coordinates with accuracies.

    camera: the aircraft's position, for distance; altitudes are AMSL.
    """
    altitude = report.height_m - geoid_separation_m
    velocity = report.velocity_ned or (NAN, NAN, NAN)
    heading = NAN
    if math.hypot(velocity[0], velocity[1]) > 0.5:
        heading = math.atan2(velocity[1], velocity[0]) % (2.0 * math.pi)
    distance = NAN
    if camera is not None:
        n, e = north_east(
            camera.latitude_deg, camera.longitude_deg, report.latitude_deg, report.longitude_deg
        )
        distance = math.sqrt(n * n + e * e + (altitude - camera.altitude_amsl_m) ** 2)
    return mavlink.MAVLink_camera_tracking_geo_status_message(
        mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE,
        round(report.latitude_deg * 1e7),
        round(report.longitude_deg * 1e7),
        altitude,
        report.h_accuracy_m,
        report.v_accuracy_m,
        *velocity,
        NAN,
        distance,
        heading,
        NAN,
    )


def camera_fov_status(
    view: CameraView, config: CameraConfig, geoid_separation_m: float, uptime_ms: int
) -> Any:
    """CAMERA_FOV_STATUS (271): camera position, attitude and the ground point in its centre."""

    def degrees_e7(value: float) -> int:
        return round(value * 1e7) if math.isfinite(value) else _INVALID_LATLON

    def altitude_mm(height_m: float) -> int:
        if not math.isfinite(height_m):
            return _INVALID_LATLON
        return round((height_m - geoid_separation_m) * 1e3)

    return mavlink.MAVLink_camera_fov_status_message(
        uptime_ms,
        degrees_e7(view.latitude_deg),
        degrees_e7(view.longitude_deg),
        altitude_mm(view.height_m),
        degrees_e7(view.image_latitude_deg),
        degrees_e7(view.image_longitude_deg),
        altitude_mm(view.image_height_m),
        list(view.quaternion_ned),
        config.horizontal_fov_deg,
        config.vertical_fov_deg,
    )


def adsb_vehicle(report: TargetReport, geoid_separation_m: float) -> Any:
    """ADSB_VEHICLE (246) for a target, so that every ground station draws it."""
    velocity = report.velocity_ned
    flags, heading, speed, climb = _ADSB_FLAGS, 0, 0, 0
    if velocity is not None:
        flags |= mavlink.ADSB_FLAGS_VALID_HEADING | mavlink.ADSB_FLAGS_VALID_VELOCITY
        heading = round(math.degrees(math.atan2(velocity[1], velocity[0])) % 360.0 * 100) % 36000
        speed = min(round(math.hypot(velocity[0], velocity[1]) * 100), 65535)
        climb = max(-32768, min(32767, round(-velocity[2] * 100)))
    return mavlink.MAVLink_adsb_vehicle_message(
        _ICAO_BASE | (report.target_id & 0xFFFF),
        round(report.latitude_deg * 1e7),
        round(report.longitude_deg * 1e7),
        mavlink.ADSB_ALTITUDE_TYPE_GEOMETRIC,
        round((report.height_m - geoid_separation_m) * 1e3),
        heading,
        speed,
        climb,
        f"TGT{report.target_id % 10000:04d}".encode(),
        mavlink.ADSB_EMITTER_TYPE_POINT_OBSTACLE
        if velocity is None
        else mavlink.ADSB_EMITTER_TYPE_SERVICE_SURFACE,
        1,
        flags,
        0,
    )


def cursor_on_target(report: TargetReport, config: TargetsConfig, utc: SteadyUtc) -> bytes:
    """A Cursor-on-Target event (XML) for ATAK and WinTAK; hae is the ellipsoidal height."""
    seen = datetime.fromtimestamp(utc.utc_ns(report.time_ns) * 1e-9, tz=timezone.utc)

    def stamp(moment: datetime) -> str:
        return moment.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"

    def accuracy(value: float) -> str:
        return f"{value:.1f}" if math.isfinite(value) else "9999999.0"  # CoT's "unknown"

    event = ElementTree.Element(
        "event",
        version="2.0",
        uid=f"pilot-target-{report.target_id}",
        type=_COT_TYPE,
        how="m-r",
        time=stamp(seen),
        start=stamp(seen),
        stale=stamp(seen + timedelta(seconds=config.cot_stale_s)),
    )
    ElementTree.SubElement(
        event,
        "point",
        lat=f"{report.latitude_deg:.7f}",
        lon=f"{report.longitude_deg:.7f}",
        hae=f"{report.height_m:.2f}",
        ce=accuracy(report.h_accuracy_m),
        le=accuracy(report.v_accuracy_m),
    )
    detail = ElementTree.SubElement(event, "detail")
    ElementTree.SubElement(detail, "contact", callsign=f"TGT{report.target_id:04d}")
    if report.elsewhere >= _TOLD_ELSEWHERE:
        remarks = ElementTree.SubElement(detail, "remarks")
        remarks.text = f"{report.elsewhere:.0%} likely on another surface (edge in the picture)"
    if report.velocity_ned is not None:
        north, east, _ = report.velocity_ned
        course = math.degrees(math.atan2(east, north)) % 360.0
        ElementTree.SubElement(
            detail, "track", course=f"{course:.1f}", speed=f"{math.hypot(north, east):.2f}"
        )
    return ElementTree.tostring(event, encoding="utf-8", xml_declaration=True)


def track_request(message: Any, time_ns: int) -> TrackRequest | None:
    """The operator's wish of a COMMAND_LONG or COMMAND_INT to the camera; None if it is none."""
    if message.command == mavlink.MAV_CMD_CAMERA_TRACK_POINT:
        coordinates = (message.param1, message.param2)
        if not all(0.0 <= c <= 1.0 for c in coordinates):
            return None
        radius = message.param3 if math.isfinite(message.param3) else 0.0
        return TrackRequest("point", time_ns, coordinates, radius)
    if message.command == mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE:
        rectangle = (message.param1, message.param2, message.param3, message.param4)
        inside = all(0.0 <= c <= 1.0 for c in rectangle)
        if not inside or rectangle[0] >= rectangle[2] or rectangle[1] >= rectangle[3]:
            return None
        return TrackRequest("rectangle", time_ns, rectangle)
    if message.command == mavlink.MAV_CMD_CAMERA_STOP_TRACKING:
        return TrackRequest("stop", time_ns)
    return None
