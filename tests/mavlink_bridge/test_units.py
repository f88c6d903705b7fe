"""Every scaled field that is sent or read, against the units in MAVLink's own definition."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import quaternion as quat
from mavlink_bridge.camera.messages import (
    adsb_vehicle,
    camera_fov_status,
    camera_information,
    tracking_geo_status,
    video_stream_information,
)
from mavlink_bridge.config import BridgeConfig, CameraConfig, InjectionConfig, OriginConfig
from mavlink_bridge.injection.encode import (
    EncodedEstimate,
    global_position_sensor,
    gps_input,
    odometry,
    vision_position_estimate,
)
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.messages import CameraView, Origin, TargetReport
from mavlink_bridge.vehicle.readings import VehicleReadings
from mavlink_bridge.vehicle.tracker import VehicleTracker
from tests.mavlink_bridge.simulated import exchanging

# How many of a unit make one degree, metre, m/s, radian or second.
PER = {
    "degE7": 1e7, "deg": 1.0, "cdeg": 100.0, "rad": math.pi / 180.0, "rad/s": 1.0, "m": 1.0,
    "mm": 1e3, "m/s": 1.0, "cm/s": 100.0, "s": 1.0, "ms": 1e3, "us": 1e6, "pix": 1.0,
}  # fmt: skip
LAT, LON, AMSL, GEOID = 47.25, 8.5, 500.0, 48.0
HEIGHT = AMSL + GEOID
NORTH, EAST, DOWN, HEADING = 3.0, 4.0, -2.0, 60.0
COURSE = math.degrees(math.atan2(EAST, NORTH))
EXPOSURE_S, NOW_S, UPTIME_S = 1000.0, 1000.2, 77.0
WEEK_S = 345_600.5
NOSE = quat.from_euler(0.0, 0.0, math.radians(HEADING))


def scaled(kind: Any, field: str, value: float) -> float:
    """A value in degrees, metres, m/s or seconds, in the unit that the field has by definition."""
    return value * PER[kind.fieldunits_by_name[field]]


def kind_of(message: Any) -> Any:
    return mavlink.mavlink_map[message.get_msgId()]


def estimate() -> EncodedEstimate:
    position = PropagatedFix(
        round(EXPOSURE_S * 1e9), LAT, LON, HEIGHT, np.diag([4.0, 4.0, 9.0]),
        np.array([NORTH, EAST, DOWN]), np.eye(3) * 0.25,
    )  # fmt: skip
    return EncodedEstimate(position, NOSE, 0.02, 80, 1, True, velocity_is_new=True)


REPORT = TargetReport(
    round(EXPOSURE_S * 1e9), LAT, LON, HEIGHT, (NORTH, EAST, DOWN), 2.0, 3.0, (0.5, 0.5)
)
VIEW = CameraView(
    round(EXPOSURE_S * 1e9), LAT, LON, HEIGHT, (1.0, 0.0, 0.0, 0.0), LAT + 1, LON + 1, HEIGHT - 9
)
CAMERA = CameraConfig(horizontal_fov_deg=62.0)
ABOVE = Origin(LAT, LON, AMSL + 100.0)
GPS = InjectionConfig(message="gps_input", gps_yaw=True)
NED = (11.0, 12.0, 13.0)
SPEED = {"vel_n": NORTH, "vel_e": EAST, "vel_d": DOWN}
PLACE = {"lat": LAT, "lon": LON}
ACCURACY = {"horiz_accuracy": 2.0, "vert_accuracy": 3.0, "speed_accuracy": 0.5}
SENT: list[tuple[Any, dict[str, float]]] = [
    (
        gps_input(estimate(), AMSL, (2300, round(WEEK_S * 1000)), GPS),
        {**PLACE, "alt": AMSL, "time_usec": EXPOSURE_S, "time_week_ms": WEEK_S, "yaw": HEADING,
         "vn": NORTH, "ve": EAST, "vd": DOWN, **ACCURACY},
    ),
    (
        global_position_sensor(estimate(), AMSL, round(NOW_S * 1e9)),
        {**PLACE, "alt": AMSL, "alt_ellipsoid": HEIGHT, "time_usec": NOW_S, "eph": 2.0, "epv": 3.0,
         "processing_time": NOW_S - EXPOSURE_S},
    ),
    (
        vision_position_estimate(estimate(), NED, "variance"),
        {"usec": EXPOSURE_S, "x": 11.0, "y": 12.0, "z": 13.0, "yaw": HEADING},
    ),
    (
        odometry(estimate(), NOSE, NED, "variance", mavlink.MAV_FRAME_LOCAL_FRD),
        {"time_usec": EXPOSURE_S, "x": 11.0, "y": 12.0, "z": 13.0, "vz": DOWN},
    ),
    (
        tracking_geo_status(REPORT, GEOID, ABOVE),
        {**PLACE, **SPEED, "alt": AMSL, "h_acc": 2.0, "v_acc": 3.0, "dist": 100.0, "hdg": COURSE},
    ),
    (
        camera_fov_status(VIEW, CAMERA, GEOID, round(UPTIME_S * 1000)),
        {"time_boot_ms": UPTIME_S, "lat_camera": LAT, "lon_camera": LON, "alt_camera": AMSL,
         "lat_image": LAT + 1, "lon_image": LON + 1, "alt_image": AMSL - 9, "hfov": 62.0,
         "vfov": CAMERA.vertical_fov_deg},
    ),
    (
        adsb_vehicle(REPORT, GEOID),
        {**PLACE, "altitude": AMSL, "heading": COURSE, "hor_velocity": 5.0, "ver_velocity": -DOWN},
    ),
    (
        camera_information(CAMERA, round(UPTIME_S * 1000)),
        {"time_boot_ms": UPTIME_S, "resolution_h": 1280, "resolution_v": 720},
    ),
    (
        video_stream_information(CAMERA),
        {"resolution_h": 1280, "resolution_v": 720, "hfov": 62.0},
    ),
]  # fmt: skip


@pytest.mark.parametrize(("message", "values"), SENT, ids=lambda v: getattr(v, "name", ""))
def test_what_is_sent_is_in_the_units_of_the_definition(message, values):
    for field, value in values.items():
        expected = scaled(kind_of(message), field, value)
        assert getattr(message, field) == pytest.approx(expected, rel=1e-6, abs=0.51), field
        if abs(expected) < 10.0:
            assert getattr(message, field) == pytest.approx(expected, rel=1e-3), field


def test_the_origin_is_set_and_read_in_the_units_of_the_definition() -> None:
    configured = OriginConfig(latitude_deg=LAT, longitude_deg=LON, altitude_amsl_m=AMSL)
    exchange, link, _ = exchanging(configured)
    for k in range(9):
        exchange.tick(link, k * 10**10, may_set=True)
    message = next(m for _, m, _ in link.sent if m.get_type() == "SET_GPS_GLOBAL_ORIGIN")
    wanted = {"latitude": LAT, "longitude": LON, "altitude": AMSL}
    for field, value in wanted.items():
        assert getattr(message, field) == round(scaled(kind_of(message), field, value))
    kind = mavlink.mavlink_map[mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN]
    fields = (round(scaled(kind, field, value)) for field, value in wanted.items())
    exchange.on_message(mavlink.MAVLink_gps_global_origin_message(*fields, 0), 0)
    assert exchange.origin == Origin(*map(pytest.approx, (LAT, LON, AMSL)))


def read(name: str, values: dict[str, float], **others: Any) -> VehicleTracker:
    """A tracker that took in one message, its fields given in degrees, metres, m/s."""
    tracker = VehicleTracker(BridgeConfig())
    for message, time_ns in sent(name, values, **others):
        tracker.handle(message, time_ns)
    return tracker


def sent(name: str, values: dict[str, float], **others: Any) -> Iterator[tuple[Any, int]]:
    """Three times a heartbeat and the message, with the times when they came."""
    vehicle = mavlink.MAVLink(None, 1, 1)
    kind = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name}")]
    fields = {n: others.get(n, 0) for n in kind.fieldnames} | {
        n: scaled(kind, n, v) for n, v in values.items()
    }
    whole = {n: f if kind.fieldtypes[kind.fieldnames.index(n)] == "float" else round(f)
             for n, f in fields.items()}  # fmt: skip
    beat = mavlink.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3)
    for k in range(3):
        for message in (beat, kind(**whole)):
            decoded = vehicle.decode(bytearray(message.pack(vehicle)))
            yield decoded, (1000 + k) * 10**6


def test_what_is_read_is_in_the_units_of_the_definition() -> None:
    place = {"lat": LAT, "lon": LON, "alt": AMSL, "relative_alt": 40.0}
    state = read("GLOBAL_POSITION_INT", place).snapshot(10**9)
    assert (state.latitude_deg, state.longitude_deg) == pytest.approx((LAT, LON), abs=1e-7)
    assert (state.altitude_amsl_m, state.altitude_relative_m) == pytest.approx((AMSL, 40.0))
    seen = {"lat": LAT, "lon": LON, "h_acc": 1.5}
    assert read("GPS_RAW_INT", seen).snapshot(10**9).gps_latitude_deg is None  # without a fix
    gps = read("GPS_RAW_INT", seen, fix_type=3).snapshot(10**9)
    assert (gps.gps_latitude_deg, gps.gps_longitude_deg) == pytest.approx((LAT, LON), abs=1e-7)
    assert gps.gps_h_accuracy_m == pytest.approx(1.5)
    local = read("LOCAL_POSITION_NED", {"x": 1, "y": 2, "z": 3, "vx": 4, "vy": 5, "vz": 6})
    assert local.snapshot(10**9).local_position_ned == (1.0, 2.0, 3.0)
    assert local.snapshot(10**9).local_velocity_ned == (4.0, 5.0, 6.0)
    attitude = read("ATTITUDE", {"roll": 10.0, "pitch": 20.0, "yaw": 30.0, "yawspeed": 0.2})
    at = attitude.attitude_at(1001 * 10**6)
    angles = np.degrees([at.roll_rad, at.pitch_rad, at.yaw_rad])
    assert angles == pytest.approx([10, 20, 30], abs=0.05)  # a millisecond on, at 0.2 rad/s
    assert at.rates[2] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("name", "angles"),
    [
        ("MOUNT_STATUS", ("pointing_a", "pointing_b", "pointing_c")),  # pitch, roll, yaw
        ("MOUNT_ORIENTATION", ("pitch", "roll", "yaw")),
    ],
)
def test_old_gimbal_angles_are_in_the_units_of_the_definition(name, angles):
    readings = VehicleReadings()
    for message, time_ns in sent(name, dict(zip(angles, (-45.0, 5.0, 30.0), strict=True))):
        readings.update(message, time_ns)
    sample = readings.gimbals.at(1001 * 10**6)
    roll, pitch, yaw = np.degrees(quat.to_euler(sample.quaternion))
    assert (pitch, roll, yaw) == pytest.approx((-45.0, 5.0, 30.0), abs=1e-3)
