"""Clock mapping, attitude and gimbal at exposure time, origin, profiles."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scipy.spatial.transform import Rotation

from mavlink_bridge import quaternion as quat
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import BridgeConfig, CameraConfig, OriginConfig
from mavlink_bridge.messages import Origin
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.origin import north_east
from mavlink_bridge.vehicle.profile import ARDUPILOT, ARDUPILOT_SQRT, GENERIC, PX4, select_profile
from mavlink_bridge.vehicle.tracker import VehicleTracker
from mavlink_bridge.vehicle_events import UnexpectedSenderMonitor
from tests.mavlink_bridge.simulated import MS, SECOND, exchanging


def sent(message: Any, system: int = 1, component: int = 1) -> Any:
    """As it comes out of a decoder: with a source."""
    codec = mavlink.MAVLink(None, system, component)
    return codec.decode(bytearray(message.pack(codec)))


def tracker(**camera: Any) -> VehicleTracker:
    it = VehicleTracker(BridgeConfig(camera=CameraConfig(**camera)))
    heartbeat = sent(mavlink.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3))
    assert it.accepts(heartbeat)
    it.handle(heartbeat, SECOND)
    return it


def feed_yaw(it: VehicleTracker, rate_hz: float, seconds: float, yaw_rate: float) -> None:
    for i in range(int(seconds * rate_hz)):
        t = i / rate_hz
        yaw = quat.wrap_pi(yaw_rate * t)
        m = mavlink.MAVLink_attitude_message(int(t * 1000), 0.0, 0.0, yaw, 0.0, 0.0, yaw_rate)
        it.handle(sent(m), 10 * SECOND + int(t * SECOND))


def test_attitude_is_interpolated_across_the_wrap_of_yaw() -> None:
    it = tracker()
    feed_yaw(it, 10.0, 8.0, math.radians(60.0))
    for ms in (2950, 3020, 3333, 6666):
        at = it.attitude_at(10 * SECOND + ms * MS)
        expected = quat.wrap_pi(math.radians(60.0) * ms / 1000)
        assert quat.wrap_pi(at.yaw_rad - expected) == pytest.approx(0.0, abs=1e-4)


def test_attitude_is_extrapolated_a_little_and_a_gap_is_none() -> None:
    it = tracker()
    feed_yaw(it, 10.0, 1.0, 0.5)
    newest = 10 * SECOND + 900 * MS
    at = it.attitude_at(newest + 80 * MS)
    assert at.yaw_rad == pytest.approx(0.5 * 0.98, abs=1e-4)
    assert it.attitude_at(newest + 200 * MS) is None
    assert it.attitude_at(10 * SECOND - 50 * MS) is None
    q = quat.from_euler(0.1, -0.2, 2.0)
    later = mavlink.MAVLink_attitude_quaternion_message(1700, *q, 0.0, 0.0, 0.0)
    it.handle(sent(later), newest + 800 * MS)
    assert it.attitude_at(newest + 400 * MS) is None
    at = it.attitude_at(newest + 800 * MS)
    assert (at.roll_rad, at.pitch_rad, at.yaw_rad) == pytest.approx((0.1, -0.2, 2.0), abs=1e-6)


def test_gyro_heading_follows_the_turn_and_ignores_resets_of_the_estimator() -> None:
    it = tracker()
    rate = math.radians(50.0)
    for i in range(500):
        t = i / 50
        estimated = quat.wrap_pi(rate * t + (0.14 if t > 5.0 else 0.0))
        m = mavlink.MAVLink_attitude_message(int(t * 1000), 0.0, 0.0, estimated, 0.0, 0.0, rate)
        it.handle(sent(m), 10 * SECOND + int(t * SECOND))
    early, late = (it.attitude_at(10 * SECOND + ms * MS) for ms in (1000, 9000))
    assert late.gyro_heading_rad - early.gyro_heading_rad == pytest.approx(rate * 8.0, abs=1e-3)


YAW_LOCK, IN_VEHICLE, IN_EARTH = 16, 32, 64


def attitude_and(it: VehicleTracker, ms: int, *messages: Any, yaw_deg: float = 0.0) -> None:
    yaw = math.radians(yaw_deg)
    attitude = mavlink.MAVLink_attitude_message(ms, 0.05, 0.02, yaw, 0.0, 0.0, 0.0)
    for m in (attitude, *messages):
        it.handle(sent(m), 10 * SECOND + ms * MS)


def device_status(ms: int, flags: int, pitch: float, yaw: float, device: int = 0) -> Any:
    q = Rotation.from_euler("ZYX", [yaw, pitch, 0.0], degrees=True).as_quat()
    return mavlink.MAVLink_gimbal_device_attitude_status_message(
        0, 0, ms, flags, list(np.roll(q, 1)), 0.0, 0.0, 0.0, 0, math.nan, math.nan, device
    )


@pytest.mark.parametrize(
    ("flags", "earth"),
    [
        (0, False),
        (YAW_LOCK, True),
        (IN_VEHICLE, False),
        (IN_EARTH, True),
        (YAW_LOCK | IN_VEHICLE, False),
        (YAW_LOCK | IN_EARTH, True),
    ],
)
def test_gimbal_frame_by_yaw_in_flags_first_then_yaw_lock(flags, earth):
    it = tracker()
    for ms in (0, 100, 200):
        attitude_and(it, ms, device_status(ms, flags, -45.0, 30.0), yaw_deg=100.0)
    at = it.gimbal_at(10 * SECOND + 150 * MS)
    assert math.degrees(at.yaw_rad) == pytest.approx(30.0 if earth else 130.0, abs=1e-3)
    assert math.degrees(at.pitch_rad) == pytest.approx(-45.0, abs=1e-3)
    assert at.source == "GIMBAL_DEVICE_ATTITUDE_STATUS"


def test_old_mount_messages_are_used_only_without_the_new_one() -> None:
    it = tracker()
    mount = mavlink.MAVLink_mount_status_message(0, 0, -3000, 100, 2000)
    for ms in (0, 100, 200):
        attitude_and(it, ms, mount, yaw_deg=10.0)
    at = it.gimbal_at(10 * SECOND + 100 * MS)
    assert at.source == "MOUNT_STATUS"
    angles = np.degrees([at.roll_rad, at.pitch_rad, at.yaw_rad])
    assert angles == pytest.approx([1.0, -30.0, 30.0], abs=1e-3)
    attitude_and(it, 300, device_status(300, IN_EARTH, -80.0, 0.0), mount)
    attitude_and(it, 400, mount)
    at = it.gimbal_at(10 * SECOND + 350 * MS)
    assert at.source == "GIMBAL_DEVICE_ATTITUDE_STATUS"


def test_fixed_camera_follows_the_body_and_its_mounting() -> None:
    it = tracker(mount="fixed", mount_pitch_deg=-60.0)
    m = mavlink.MAVLink_attitude_message(0, 0.0, math.radians(10.0), 1.0, 0.0, 0.0, 0.0)
    it.handle(sent(m), 10 * SECOND)
    at = it.gimbal_at(10 * SECOND)
    assert math.degrees(at.pitch_rad) == pytest.approx(-50.0, abs=1e-3)
    assert at.yaw_rad == pytest.approx(1.0, abs=1e-6)
    assert at.source == "fixed"


def test_other_systems_ground_stations_and_companions_are_not_the_vehicle() -> None:
    it = VehicleTracker(BridgeConfig())
    assert not it.accepts(sent(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), 255, 190))
    assert not it.accepts(sent(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 7, 191))
    assert it.snapshot(SECOND).system_id is None
    vehicle = sent(mavlink.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3), 7, 1)
    assert it.accepts(vehicle)
    it.handle(vehicle, SECOND)
    assert it.snapshot(SECOND).system_id == 7
    other = sent(mavlink.MAVLink_attitude_message(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 8, 1)
    assert not it.accepts(other)


def test_position_at_null_island_is_no_position() -> None:
    it = tracker()
    for lat in (0, 473977420):
        m = mavlink.MAVLink_global_position_int_message(1, lat, 0, 500000, 0, 0, 0, 0, 0)
        it.handle(sent(m), 10 * SECOND)
        assert (it.snapshot(SECOND).latitude_deg is not None) is (lat != 0)


@pytest.mark.parametrize(("before", "after"), [(1_799_999_900, -1_799_999_700), (-300, 100)])
def test_between_two_places_the_way_over_the_date_line_is_the_short_one(before, after):
    it = tracker()
    for ms, lon in ((1, before), (201, after)):
        m = mavlink.MAVLink_global_position_int_message(
            ms, -168_000_000, lon, 500000, 0, 0, 0, 0, 0
        )
        it.handle(sent(m), 10 * SECOND + ms * MS)
    found = it.global_at(10 * SECOND + 101 * MS)
    assert found is not None
    north, east = north_east(-16.8, before * 1e-7, found[0], found[1])
    assert (north, east) == pytest.approx((0.0, 200e-7 * 111_319 * 0.957), abs=0.1)
    assert -180.0 <= found[1] <= 180.0


def test_a_copy_of_an_old_frame_does_not_turn_the_position_back() -> None:
    it = tracker()
    for ms, north, later in ((1000, 5.0, 0), (500, 1.0, 3)):
        m = mavlink.MAVLink_local_position_ned_message(ms, north, 0.0, 0.0, 0.0, 0.0, 0.0)
        it.handle(sent(m), (11 + later) * SECOND)
    assert it.snapshot(11 * SECOND).local_position_ned == (5.0, 0.0, 0.0)


def test_what_a_hard_flight_measures_is_taken() -> None:
    it = tracker()
    rates = (20.0, -20.0, 35.0)  # rad/s: past the end of a common gyro's scale
    for m in (
        mavlink.MAVLink_attitude_message(20, -3.1, 1.5, 6.2, *rates),
        mavlink.MAVLink_highres_imu_message(40_000, 300.0, -300.0, 300.0, *rates, *[0.0] * 7, 63),
        mavlink.MAVLink_scaled_pressure_message(60, 265.0, 0.0, -5000),  # at 10 km
        mavlink.MAVLink_local_position_ned_message(80, 9e4, -9e4, -9e3, 200.0, 200.0, 50.0),
    ):
        it.handle(sent(m), 10 * SECOND)
    state = it.snapshot(10 * SECOND)
    assert it.ignored == 0
    assert state.local_position_ned == (9e4, -9e4, -9e3)
    assert state.pressure_altitude_m == pytest.approx(10_000.0, abs=50.0)
    assert len(it.inertial_since(0)) == 1


def distance(ms: int, cm: int, *, orientation: int = 25, quality: int = 0) -> Any:
    return mavlink.MAVLink_distance_sensor_message(
        ms, 20, 9000, cm, 0, 0, orientation, 255, signal_quality=quality
    )


@pytest.mark.parametrize(
    "odd",
    [
        distance(40, 300, orientation=0),  # what lies ahead
        distance(40, 9000),  # as far as it reaches: nothing came back
        distance(40, 0),
        distance(40, 19),
        distance(40, 65535),
        distance(40, 300, quality=1),  # invalid, as it says itself
    ],
)
def test_what_is_no_reading_of_the_ground_is_left_out(odd: Any) -> None:
    it = tracker()
    it.handle(sent(distance(20, 4512)), 10 * SECOND)
    before = it.snapshot(10 * SECOND).rangefinder_time_ns
    it.handle(sent(odd), 10 * SECOND + 20 * MS)
    state = it.snapshot(10 * SECOND + 20 * MS)
    assert state.rangefinder_m == pytest.approx(45.12)
    assert state.rangefinder_time_ns == before


# --- origin -----------------------------------------------------------------------------------


def test_scaling_is_ardupilots_own() -> None:
    # Location::get_distance_NE with LOCATION_SCALING_FACTOR and the mean latitude.
    dlat, dlon = 123456, -234567  # 1e-7 deg
    lat, lon = 47.397742, 8.545594
    mean = math.radians(lat + dlat * 1e-7 / 2)
    expected = (dlat * 0.011131884502145034, dlon * 0.011131884502145034 * math.cos(mean))
    assert north_east(lat, lon, lat + dlat * 1e-7, lon + dlon * 1e-7) == pytest.approx(expected)


def test_origin_is_read_and_only_set_when_the_vehicle_has_none() -> None:
    configured = OriginConfig(latitude_deg=47.0, longitude_deg=8.0, altitude_amsl_m=500.0)
    exchange, link, told = exchanging(configured)
    for second in range(1, 6):
        exchange.tick(link, second * SECOND, may_set=True)
    kinds = [m.get_type() for _, m, _ in link.sent]
    assert kinds == [*["COMMAND_LONG"] * 4, "SET_GPS_GLOBAL_ORIGIN", "COMMAND_LONG"]
    assert {m.param1 for _, m, _ in link.sent if m.get_type() == "COMMAND_LONG"} == {49}
    # What firmwares send before they have one.
    exchange.on_message(mavlink.MAVLink_gps_global_origin_message(0, 0, 0), 6 * SECOND)
    assert exchange.origin is None
    # The vehicle has another one: ours is ignored, and so must positions be relative to the read.
    read = mavlink.MAVLink_gps_global_origin_message(471000000, 80000000, 480000)
    exchange.on_message(read, 6 * SECOND)
    assert [a.id for a in told] == [AlertId.ORIGIN_DIFFERS]
    assert exchange.origin == Origin(pytest.approx(47.1), pytest.approx(8.0), pytest.approx(480.0))
    exchange.tick(link, 10 * SECOND, may_set=True)
    assert len(link.sent) == 7  # only asked again


# --- profiles ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("autopilot", "version", "profile"),
    [
        ("ardupilot", (4, 5, 0), ARDUPILOT),
        ("ardupilot", (4, 7, 9), ARDUPILOT),
        ("ardupilot", None, ARDUPILOT),
        ("ardupilot", (4, 8, 0), ARDUPILOT_SQRT),
        ("ardupilot", (4, 1, 0), GENERIC),
        ("px4", (1, 15, 2), PX4),
        ("px4", (1, 12, 0), GENERIC),
        ("unknown", (1, 0, 0), GENERIC),
    ],
)
def test_profile_of_a_firmware(autopilot: str, version: Any, profile: Any) -> None:
    assert select_profile(autopilot, version) is profile


def fly_level(
    it: VehicleTracker, seconds: float, speaks: Callable[[int], dict[tuple[int, int], float]]
) -> None:
    """Attitudes at 20 Hz, and the yaw from the vehicle's heading of whoever speaks at a time in ms:
    (component, device).
    """
    for at_ms in range(0, round(seconds * 1000), 50):
        attitude_and(it, at_ms)
        for (component, device), yaw_deg in speaks(at_ms).items():
            status = device_status(at_ms, IN_VEHICLE, -30.0, yaw_deg, device)
            message = sent(status, component=component)
            assert it.accepts(message)
            it.handle(message, 10 * SECOND + at_ms * MS)


CAMERA_GIMBAL, OTHER_GIMBAL = (1, 1), (1, 2)


def looks(it: VehicleTracker, at_ms: int) -> float:
    gimbal = it.gimbal_at(10 * SECOND + at_ms * MS)
    return math.degrees(gimbal.yaw_rad)


@pytest.mark.parametrize("other", [OTHER_GIMBAL, (154, 0)])
def test_the_angles_of_two_gimbals_are_not_mixed(other: tuple[int, int]) -> None:
    """Each report of the second one turned the camera by 90 degrees."""
    it = tracker()
    fly_level(it, 4.0, lambda at_ms: {other: 100.0} if at_ms % 100 else {CAMERA_GIMBAL: 10.0})
    assert looks(it, 2025) == pytest.approx(10.0, abs=0.01)
    assert looks(it, 2075) == pytest.approx(10.0, abs=0.01)
    assert it.other_gimbals == (other,)
    told: list[Alert] = []
    notifier = StatusNotifier(told.append)
    watch = UnexpectedSenderMonitor(BridgeConfig(), it, notifier, Counter())
    link: Any = SimpleNamespace(stranger="", system_id=1)
    for _ in range(3):
        watch.check(link, 20 * SECOND)
    assert told == [alert(AlertId.GIMBAL_IGNORED, component=other[0], device=other[1])]


def test_foreign_senders_in_turn_do_not_flood_the_ground_station() -> None:
    """Two of them made 100 texts in 10 s: whoever was not the last one was news."""
    told: list[Alert] = []
    watch = UnexpectedSenderMonitor(
        BridgeConfig(), tracker(), StatusNotifier(told.append), Counter()
    )
    for k in range(100):
        link: Any = SimpleNamespace(stranger=f"127.0.0.{2 + k % 2}", system_id=1)
        watch.check(link, 20 * SECOND)
    assert len(told) == 2
    for k in range(100):  # a forger has many names
        link = SimpleNamespace(stranger=f"127.0.1.{k}", system_id=1)
        watch.check(link, 20 * SECOND)
    assert len(told) == 4


def test_the_configured_gimbal_counts_whoever_spoke_first() -> None:
    it = VehicleTracker(BridgeConfig(camera=CameraConfig(gimbal_device=2)))
    it.handle(sent(mavlink.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3)), SECOND)
    fly_level(it, 2.0, lambda _: {CAMERA_GIMBAL: 10.0, OTHER_GIMBAL: 100.0})
    assert looks(it, 1025) == pytest.approx(100.0, abs=0.01)


def test_a_gimbal_that_falls_silent_makes_room() -> None:
    it = tracker()
    fly_level(
        it, 6.0, lambda at_ms: {CAMERA_GIMBAL: 10.0} if at_ms < 1000 else {OTHER_GIMBAL: 100.0}
    )
    assert looks(it, 5500) == pytest.approx(100.0, abs=0.01)


@pytest.mark.parametrize(
    ("latitude", "longitude", "altitude_m"),
    [(0, 0, 500), (950_000_000, 0, 500), (1, 1_900_000_000, 500), (470_000_000, 80_000_000, 9e4)],
)
def test_a_receiver_where_there_is_no_place_is_not_heard(latitude, longitude, altitude_m):
    """A 3D fix in the Gulf of Guinea, beyond a pole, in space: GNSS would count as healthy."""
    it = tracker()

    def says(at_s: float, *place: int) -> None:
        m = mavlink.MAVLink_gps_raw_int_message(0, 3, *place, 80, 100, 0, 0, 12, 0, 0, 1000)
        it.handle(sent(m), round(at_s * SECOND))

    says(10.0, 470_000_000, 80_000_000, 500_000)
    says(11.0, latitude, longitude, round(altitude_m * 1e3))
    state = it.snapshot(11 * SECOND)
    assert state.gps_latitude_deg == pytest.approx(47.0)
    assert state.gps_time_ns == 10 * SECOND
    assert it.ignored == 1
    # Without a fix the place means nothing, and the report that there is none does.
    lost = mavlink.MAVLink_gps_raw_int_message(0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    it.handle(sent(lost), 12 * SECOND)
    assert it.snapshot(12 * SECOND).gps_fix_type == 0
