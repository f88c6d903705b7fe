"""Messages of camera and targets in MAVLink camera protocol v2: description, view, requests.

https://mavlink.io/en/services/camera.html

CAMERA_TRACKING_GEO_STATUS is the standard for a target's coordinates; CAMERA_TRACKING_IMAGE_STATUS
is what QGroundControl and Mission Planner draw; ADSB_VEHICLE is what all three draw on the map
(ground link only: ArduPilot ingests it as traffic).
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import CameraConfig
from mavlink_bridge.messages import CameraView, Origin, TargetReport, TrackRequest, or_nan
from mavlink_bridge.vehicle.origin import north_east

_ADSB_FLAGS = (
    mavlink.ADSB_FLAGS_VALID_COORDS
    | mavlink.ADSB_FLAGS_VALID_ALTITUDE
    | mavlink.ADSB_FLAGS_VALID_CALLSIGN
)
_IDLE = int(mavlink.CAMERA_TRACKING_STATUS_FLAGS_IDLE)
_ELSEWHERE = 0.05  # a target more likely on another surface than this is not confirmed
_ICAO_BASE = 0xF00000  # unassigned block; the low bits carry the target's number


def tracking_image_status(report: TargetReport | None) -> Any:
    """CAMERA_TRACKING_IMAGE_STATUS (275): its rectangle or point; None or without both: idle."""
    point, rectangle, mode = (NAN, NAN), (NAN,) * 4, mavlink.CAMERA_TRACKING_MODE_NONE
    if report is not None and report.rectangle is not None:
        rectangle, mode = report.rectangle, mavlink.CAMERA_TRACKING_MODE_RECTANGLE
    elif report is not None and report.pixel is not None:
        point, mode = report.pixel, mavlink.CAMERA_TRACKING_MODE_POINT
    active = _status(report) if report is not None and mode else _IDLE
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

    camera: the aircraft's position, for the distance (None: NaN). Altitudes are AMSL.
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
        _status(report),
        round(report.latitude_deg * 1e7),
        round(report.longitude_deg * 1e7),
        altitude,
        or_nan(report.h_accuracy_m),
        or_nan(report.v_accuracy_m),
        *velocity,
        or_nan(report.velocity_accuracy_mps),
        distance,
        heading,
        NAN,
    )


def image_captured(
    report: TargetReport, geoid_separation_m: float, index: int, uptime_ms: int, utc_us: int
) -> Any:
    """CAMERA_IMAGE_CAPTURED (263) at the target's position: QGroundControl marks it on its map.

    index: counter of these messages. No image is stored, so the file's address is empty.
    """
    altitude_mm = round((report.height_m - geoid_separation_m) * 1e3)
    return mavlink.MAVLink_camera_image_captured_message(
        uptime_ms,
        utc_us,
        0,
        round(report.latitude_deg * 1e7),
        round(report.longitude_deg * 1e7),
        altitude_mm,
        0,
        (NAN,) * 4,
        index,
        1,
        b"",
    )


def is_confirmed(report: TargetReport, sigma_m: float) -> bool:
    """Whether the target is detected now, with at most sigma_m, and probably on this surface."""
    accuracy = report.h_accuracy_m
    is_known = accuracy is not None and accuracy <= sigma_m
    return is_known and not report.coasting and report.elsewhere < _ELSEWHERE


def _status(report: TargetReport) -> int:
    """CAMERA_TRACKING_STATUS_FLAGS of an active target."""
    active = int(mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE)
    return active | (mavlink.CAMERA_TRACKING_STATUS_FLAGS_COASTING if report.coasting else 0)


def adsb_vehicle(report: TargetReport, geoid_separation_m: float) -> Any:
    """ADSB_VEHICLE (246) for a target, so that every ground station draws it; altitude AMSL."""
    velocity = report.velocity_ned
    flags, heading, speed, climb = _ADSB_FLAGS, 0, 0, 0
    if velocity is not None:
        flags |= mavlink.ADSB_FLAGS_VALID_HEADING | mavlink.ADSB_FLAGS_VALID_VELOCITY
        heading = round(math.degrees(math.atan2(velocity[1], velocity[0])) % 360.0 * 100) % 36000
        speed = min(round(math.hypot(velocity[0], velocity[1]) * 100), 65535)
        climb = max(-32768, min(32767, round(-velocity[2] * 100)))
    return mavlink.MAVLink_adsb_vehicle_message(
        _ICAO_BASE | (report.target_id & 0xFFFFF),
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


NAN = math.nan
_INVALID_LATLON = 0x7FFFFFFF  # INT32_MAX: unknown coordinate, by the message's definition
_CAMERA_FLAGS = (
    mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT
    | mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
    | mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS
)
_FIRMWARE = 1  # 0.0.0.1 as MAVLink packs it: (dev << 24) + (patch << 16) + (minor << 8) + major


def _text(value: str, length: int) -> list[int]:
    """Text as a uint8[length] field, zero-terminated."""
    raw = value.encode("ascii", "replace")[: length - 1]
    return list(raw) + [0] * (length - len(raw))


def camera_information(config: CameraConfig, uptime_ms: int) -> Any:
    """CAMERA_INFORMATION (259) with the tracking flags; focal length and sensor size unknown.

    A video stream is announced only if it has an address. Otherwise QGroundControl would replace
    the video that the user has set by a stream that does not exist.
    """
    flags = _CAMERA_FLAGS
    if config.stream_uri:
        flags |= mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
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
        flags,
        0,
        b"",
    )


def video_stream_information(config: CameraConfig) -> Any:
    """VIDEO_STREAM_INFORMATION (269) of the one stream."""
    kind, address = stream_address(config.stream_uri)
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
        address.encode("ascii", "replace"),
    )


def stream_address(uri: str) -> tuple[int, str]:
    """VIDEO_STREAM_TYPE and the message's uri field: the address to connect to, or for UDP the port
    to listen at.

    QGroundControl and Mission Planner append the field of an MPEG-TS stream to "0.0.0.0:", so the
    field contains the port alone.
    """
    scheme, _, rest = uri.rpartition("://")
    if scheme in ("rtsp", "rtsps"):
        return int(mavlink.VIDEO_STREAM_TYPE_RTSP), uri
    if scheme == "tcp":
        return int(mavlink.VIDEO_STREAM_TYPE_TCP_MPEG), rest
    port = rest.partition("?")[0].rpartition(":")[2].strip("/")
    return int(mavlink.VIDEO_STREAM_TYPE_MPEG_TS), port


def camera_fov_status(
    view: CameraView, config: CameraConfig, geoid_separation_m: float, uptime_ms: int
) -> Any:
    """CAMERA_FOV_STATUS (271): camera position, attitude and the ground point in the middle of the
    image, with heights above mean sea level. geoid_separation_m: geoid above the ellipsoid.
    """

    def degrees_e7(value: float | None) -> int:
        return _INVALID_LATLON if value is None else round(value * 1e7)

    def altitude_mm(height_m: float | None) -> int:
        if height_m is None:
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
        *(view.fov_deg or (config.horizontal_fov_deg, config.vertical_fov_deg)),
    )


def track_request(message: Any, time_ns: int) -> TrackRequest | None:
    """Track request of a command, without a number yet; None if other or outside the image."""
    if message.command == mavlink.MAV_CMD_CAMERA_TRACK_POINT:
        coordinates = (message.param1, message.param2)
        if not all(0.0 <= c <= 1.0 for c in coordinates):
            return None
        radius = message.param3 if 0.0 <= message.param3 <= 1.0 else 0.0
        return TrackRequest("point", time_ns, coordinates, radius)
    if message.command == mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE:
        rectangle = (message.param1, message.param2, message.param3, message.param4)
        inside = all(0.0 <= c <= 1.0 for c in rectangle)
        if not inside or rectangle[0] >= rectangle[2] or rectangle[1] >= rectangle[3]:
            return None
        return TrackRequest("rectangle", time_ns, rectangle)
    if message.command == mavlink.MAV_CMD_CAMERA_STOP_TRACKING:
        # Ours: the number of a target, where the standard has a reserved 0.
        number = message.param1 if math.isfinite(message.param1) else 0.0
        return TrackRequest("stop", time_ns, number=max(0, min(int(number), 1 << 24)))
    return None
