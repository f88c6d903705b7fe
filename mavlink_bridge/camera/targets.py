"""Messages about a target: its coordinates, its position in the image, and its marker on the map.

CAMERA_TRACKING_GEO_STATUS is the standard for a target's coordinates;
CAMERA_TRACKING_IMAGE_STATUS is what QGroundControl and Mission Planner draw; ADSB_VEHICLE is what
all three draw on the map (ground link only: ArduPilot ingests it as traffic).
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.messages import Origin, TargetReport, or_nan
from mavlink_bridge.vehicle.origin import north_east

NAN = math.nan
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
