"""Messages of the camera in MAVLink camera protocol v2: description, view, requests.

https://mavlink.io/en/services/camera.html
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import CameraConfig
from mavlink_bridge.messages import CameraView, TrackRequest

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
