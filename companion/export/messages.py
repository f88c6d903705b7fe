"""Converts rows of a record to messages of Foxglove's schemas (package foxglove-schemas-protobuf).

A row maps column names to numbers or their text, so that recorded and live rows are processed
alike. time_ns: UTC. Frames: "map" is the map's ENU in metres; "camera" is OpenCV's (x right, y
down, z forward).
Heights are above the WGS84 ellipsoid.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.duration_pb2 import Duration
from google.protobuf.timestamp_pb2 import Timestamp

from localizer.geometry.camera import Camera

Row = Mapping[str, Any]
WORLD, CAMERA, AUTOPILOT, RECEIVER = "map", "camera", "autopilot", "gnss"

DIAGNOSTICS_NAME = "companion.Diagnostics"
_NUMBERS = (
    "quality", "sigma_east_m", "sigma_north_m", "sigma_up_m", "sigma_rotation_rad", "hpl_m",
    "vpl_m", "reference_ms", "extract_ms", "register_ms", "latency_ms",
)  # fmt: skip
DIAGNOSTICS_SCHEMA = {
    "title": DIAGNOSTICS_NAME,
    "type": "object",
    "properties": {
        "timestamp": {
            "type": "object", "title": "time",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "state": {"type": "string"},
        "status": {"type": "string"},
        "accepted": {"type": "boolean"},
        **{name: {"type": "number"} for name in _NUMBERS},
    },
    "required": ["timestamp", "state", "status", "accepted"],
}  # fmt: skip

_TARGET_S = 10  # after which a target that is not seen again is no longer drawn
_LEAST_M = 0.2  # so that a sphere can be seen
_PINK = (1.0, 0.18, 0.82)
_AXES = ("east", "north", "up")
_LEVELS = {"debug": Log.DEBUG, "info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}
_SEVERITIES = (
    Log.FATAL, Log.FATAL, Log.FATAL, Log.ERROR, Log.WARNING, Log.INFO, Log.INFO, Log.DEBUG,
)  # fmt: skip  # MAV_SEVERITY 0 to 7


def stamp(time_ns: int) -> Timestamp:
    """Timestamp of UTC nanoseconds."""
    return Timestamp(seconds=time_ns // 1_000_000_000, nanos=time_ns % 1_000_000_000)


def pose(row: Row, time_ns: int) -> PoseInFrame:
    """Pose of the camera in the frame "map"."""
    at = Pose(position=_vector(row), orientation=_quaternion(row))
    return PoseInFrame(timestamp=stamp(time_ns), frame_id=WORLD, pose=at)


def transform(row: Row, time_ns: int) -> FrameTransforms:
    """Transform from "map" to "camera", for data shown in the camera's frame."""
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=stamp(time_ns), parent_frame_id=WORLD, child_frame_id=CAMERA,
                translation=_vector(row), rotation=_quaternion(row),
            )
        ]
    )  # fmt: skip


# Of each who tells a place, on a viewer's map; Rerun's check refuses a place without a colour.
_COLOURS = {
    CAMERA: Color(r=0.16, g=0.62, b=0.95, a=1.0),
    AUTOPILOT: Color(r=1.0, g=0.65, b=0.1, a=1.0),
    RECEIVER: Color(r=0.6, g=0.6, b=0.6, a=1.0),
}


def location(row: Row, time_ns: int) -> LocationFix:
    """Position of the camera in WGS84, with the recorded diagonal of its covariance."""
    sigma = [float(row[f"sigma_{axis}_m"]) for axis in _AXES]
    covariance = [sigma[i] ** 2 if i == j else 0.0 for i in range(3) for j in range(3)]
    return LocationFix(
        timestamp=stamp(time_ns), frame_id=CAMERA, latitude=float(row["latitude_deg"]),
        longitude=float(row["longitude_deg"]), altitude=float(row["height_m"]),
        position_covariance=covariance, position_covariance_type=LocationFix.DIAGONAL_KNOWN,
        color=_COLOURS[CAMERA],
    )  # fmt: skip


def reported_location(
    frame: str, place: tuple[float, float, float], sigma_m: float | None, time_ns: int
) -> LocationFix:
    """Position by another source: latitude, longitude (degrees), height above the ellipsoid (m).
    sigma_m: horizontal, None if unknown.
    """
    known = sigma_m is not None and math.isfinite(sigma_m)
    variance = 0.0 if sigma_m is None or not known else sigma_m**2
    kind = LocationFix.APPROXIMATED if known else LocationFix.UNKNOWN
    return LocationFix(
        timestamp=stamp(time_ns), frame_id=frame, latitude=place[0], longitude=place[1],
        altitude=place[2], position_covariance_type=kind,
        position_covariance=[variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, 0.0],
        color=_COLOURS[frame],
    )  # fmt: skip


def diagnostics(row: Row, time_ns: int) -> dict[str, Any]:
    """Diagnostics of one estimate, accepted or not; `DIAGNOSTICS_SCHEMA`. Unknown numbers are left
    out.
    """
    numbers = {name: _number(row.get(name)) for name in _NUMBERS}
    return {
        "timestamp": {"sec": time_ns // 1_000_000_000, "nsec": time_ns % 1_000_000_000},
        "state": str(row["state"]),
        "status": str(row["status"]),
        "accepted": is_accepted(row),
        **{name: value for name, value in numbers.items() if value is not None},
    }


def is_accepted(row: Row) -> bool:
    """Whether the row's estimate was accepted."""
    return float(row["accepted"]) > 0


def image(jpeg: bytes, time_ns: int) -> CompressedImage:
    """A recorded JPEG image."""
    return CompressedImage(timestamp=stamp(time_ns), frame_id=CAMERA, data=jpeg, format="jpeg")


def calibration(camera: Camera, time_ns: int) -> CameraCalibration:
    """Camera calibration; the first pixel's centre is (0, 0) there and (0.5, 0.5) here."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5
    return CameraCalibration(
        timestamp=stamp(time_ns), frame_id=CAMERA, width=camera.width, height=camera.height,
        distortion_model=_distortion_model(camera), D=camera.distortion,
        K=[fx, 0, cx, 0, fy, cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1], P=[fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
    )  # fmt: skip


def _distortion_model(camera: Camera) -> str:
    if camera.distortion_model == "fisheye":
        return "kannala_brandt"
    return {5: "plumb_bob", 8: "rational_polynomial"}.get(len(camera.distortion), "opencv")


def target(row: Row, time_ns: int) -> SceneUpdate:
    """A target in 3-D: a sphere of one sigma, and its name with latitude and longitude."""
    name = str(row["target_id"])
    sigma, up = (
        max(_number(row[k]) or 0.0, _LEAST_M) for k in ("sigma_horizontal_m", "sigma_up_m")
    )
    latitude, longitude = (f"{float(row[f'{k}tude_deg']):.7f}" for k in ("lati", "longi"))
    at = Pose(position=_vector(row), orientation=Quaternion(w=1.0))
    facts = {
        "latitude_deg": latitude, "longitude_deg": longitude, "height_m": row["height_m"],
        "sigma_horizontal_m": row["sigma_horizontal_m"], "sigma_up_m": row["sigma_up_m"],
        "elsewhere": row["elsewhere"], "visibility": row.get("visibility", ""),
    }  # fmt: skip
    red, green, blue = _PINK
    entity = SceneEntity(
        timestamp=stamp(time_ns), frame_id=WORLD, id=name, lifetime=Duration(seconds=_TARGET_S),
        metadata=[KeyValuePair(key=k, value=str(v)) for k, v in facts.items()],
        spheres=[
            SpherePrimitive(
                pose=at, size=Vector3(x=2 * sigma, y=2 * sigma, z=2 * up),
                color=Color(r=red, g=green, b=blue, a=0.6),
            )
        ],
        texts=[
            TextPrimitive(
                pose=at, billboard=True, font_size=14.0, scale_invariant=True,
                color=Color(r=red, g=green, b=blue, a=1.0), text=f"{name}\n{latitude} {longitude}",
            )
        ],
    )  # fmt: skip
    return SceneUpdate(entities=[entity])


def target_on_map(row: Row) -> GeoJSON:
    """The target as GeoJSON for a 2-D map."""
    numbers = [float(row[k]) for k in ("longitude_deg", "latitude_deg", "height_m")]
    feature = {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": numbers},
        "properties": {
            "name": str(row["target_id"]), "sigma_m": _number(row["sigma_horizontal_m"])
        },
    }  # fmt: skip
    return GeoJSON(geojson=json.dumps(feature))


def event(row: Row, time_ns: int) -> Log:
    """A row of ``events.csv`` as a log message."""
    level = _LEVELS.get(str(row["level"]), Log.INFO)
    alert, text = str(row.get("alert") or ""), str(row["text"])  # of 0.1 a record has no alerts
    return Log(timestamp=stamp(time_ns), level=level, message=text, name="companion", file=alert)


def status_text(text: str, severity: int, sender: str, time_ns: int) -> Log:
    """A MAVLink STATUSTEXT as a log message. severity: MAV_SEVERITY."""
    level = _SEVERITIES[severity] if 0 <= severity < len(_SEVERITIES) else Log.UNKNOWN
    return Log(timestamp=stamp(time_ns), level=level, message=text, name=sender)


def _vector(row: Row) -> Vector3:
    return Vector3(**{x: float(row[f"{name}_m"]) for x, name in zip("xyz", _AXES, strict=True)})


def _quaternion(row: Row) -> Quaternion:
    return Quaternion(**{x: float(row[f"q{x}"]) for x in "wxyz"})


def _number(value: Any) -> float | None:
    """The number; None for an empty field and for NaN or infinity, which JSON does not have."""
    if value is None or value == "":
        return None
    number = float(value)
    return number if math.isfinite(number) else None
