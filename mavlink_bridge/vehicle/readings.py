"""Converts the vehicle's messages to the bridge's units and frames."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import quaternion as quat
from mavlink_bridge.messages import Attitude, InertialSample, Origin, VehicleState
from mavlink_bridge.vehicle.buffers import (
    GIMBAL_SOURCES,
    AttitudeBuffer,
    GimbalBuffer,
    GimbalSample,
    InertialBuffer,
    PlaceBuffer,
    VectorBuffer,
    VectorSample,
    ZoomBuffer,
    attitude,
)
from mavlink_bridge.vehicle.profile import autopilot_name, decode_version, select_profile

_MILLI_G = 9.80665e-3  # m/s^2
_SEA_LEVEL_HPA = 1013.25
_PRESSURE_HPA = (1.0, 1200.0)  # of air that an aircraft flies in
# Beyond these no sensor measures and no aircraft flies. One such value would stay for good in what
# is integrated (the heading of the gyros, the way of the IMU) or make a flight look like a jump.
_ZOOM_PERCENT = 100.0
ANGLE_RAD = 10.0
_RATE_RADPS = 100.0
_FORCE_MPS2 = 1_000.0
_DISTANCE_M = 1e6
_SPEED_MPS = 1_000.0
_FIX_3D = 3  # GPS_FIX_TYPE
_DISARMED_NS = 3_000_000_000  # two heartbeats of an armed vehicle may be lost in it
_HEIGHTS_MM = (-1_000_000, 50_000_000)  # AMSL: the Dead Sea's shore, and above any aircraft
_ACCURACY_MM = 100_000_000  # beyond it, as of UINT32_MAX, a receiver says that it does not know
_INVALID_SIGNAL = 1  # signal_quality of DISTANCE_SENSOR; 0: not said
_SATURATED = 32_767  # of an int16: what the sensor could not say
_GONE_NS = 3_000_000_000  # of an autopilot or a sensor: then another may take its place


def is_autopilot(message: Any) -> bool:
    """Whether a heartbeat is from an autopilot, not from a ground station, camera or companion."""
    return bool(
        message.get_type() == "HEARTBEAT"
        and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID
        and message.type != mavlink.MAV_TYPE_GCS
        and message.get_srcSystem() != 0
    )


def gimbal_in_earth_frame(flags: int) -> bool:
    """Whether GIMBAL_DEVICE_ATTITUDE_STATUS gives yaw from north, by YAW_IN_* or else YAW_LOCK."""
    if flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME:
        return False
    if flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME:
        return True
    return bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK)


class Arming:
    """Armed state by the heartbeats. changes: how often consecutive heartbeats differed."""

    def __init__(self) -> None:
        self.changes = 0
        self._flag = self._armed = False
        self._armed_ns = 0  # when it last said so

    def update(self, flag: bool, time_ns: int) -> bool:
        """Process a heartbeat's armed flag; returns the state. The state becomes disarmed only
        after 3 s without an armed heartbeat, so that a forged heartbeat unlocks nothing in flight.
        """
        self.changes += flag != self._flag
        self._flag = flag
        if flag:
            self._armed_ns = time_ns
        self._armed = flag or (self._armed and time_ns - self._armed_ns < _DISARMED_NS)
        return self._armed


class VehicleReadings:
    """Newest values and interpolation buffers of the telemetry; guarded by the tracker's lock.

    globals: the EKF's latitude, longitude (degrees), altitude AMSL. locals: its NED position from
    the origin. gimbal: component and device whose angles are used, 0 for any. impostors: number of
    messages with the vehicle's ids that state another firmware or vehicle type.

    Above 200 lines: one short method for each of its messages.
    """

    def __init__(self, gimbal: tuple[int, int] = (0, 0)) -> None:
        self.state = VehicleState()
        self.heartbeat_ns: int | None = None
        self.arming = Arming()
        self.attitudes = AttitudeBuffer()
        self.gimbals = GimbalBuffer(gimbal)
        self.globals = PlaceBuffer()
        self.locals = VectorBuffer()
        self.inertial = InertialBuffer()
        self.zooms = ZoomBuffer()
        self.impostors = 0
        self._ranger: int | None = None  # id of the sensor whose distances count

    def update(self, message: Any, time_ns: int) -> None:
        """Process one of MESSAGES_IN, valid at time_ns; ValueError for impossible values."""
        _HANDLERS[message.get_type()](self, message, time_ns)

    def set_origin(self, origin: Origin | None) -> None:
        """Set the EKF origin in the state; None: unknown."""
        self.state = replace(self.state, origin=origin)

    def forget(self) -> None:
        """Drop the origin, the version and all samples from before a reboot."""
        for buffer in (
            self.attitudes,
            self.gimbals,
            self.globals,
            self.locals,
            self.inertial,
            self.zooms,
        ):
            buffer.clear()
        self.set_origin(None)
        # It may have got another firmware, and is asked for it again.
        self.state = replace(
            self.state, version=None, profile=select_profile(self.state.autopilot, None).name
        )

    def _heartbeat(self, m: Any, time_ns: int) -> None:
        if not is_autopilot(m):
            return
        self._check_make(autopilot_name(m.autopilot), time_ns)
        self.heartbeat_ns = time_ns
        armed = self.arming.update(bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED), time_ns)
        autopilot = autopilot_name(m.autopilot)
        self.state = replace(
            self.state,
            system_id=m.get_srcSystem(),
            component_id=m.get_srcComponent(),
            autopilot=autopilot,
            armed=armed,
            custom_mode=m.custom_mode,
            mode=mavutil.mode_string_v10(m),
            system_status=m.system_status,
            profile=select_profile(autopilot, self.state.version).name,
        )

    def _version(self, m: Any, _: int) -> None:
        version = decode_version(m.flight_sw_version)
        if self.state.version not in (None, version):
            self.impostors += 1
            raise ValueError(f"{version}: no firmware changes while it runs")
        name = select_profile(self.state.autopilot, version).name
        self.state = replace(self.state, version=version, profile=name)

    def _check_make(self, autopilot: str, time_ns: int) -> None:
        """ValueError for another make of autopilot while the first is heard."""
        update = self.heartbeat_ns is not None and time_ns - self.heartbeat_ns < _GONE_NS
        if update and autopilot != self.state.autopilot:
            self.impostors += 1
            raise ValueError(f"{autopilot}: an autopilot of another make")

    def _attitude_euler(self, m: Any, time_ns: int) -> None:
        check_within(ANGLE_RAD, m.roll, m.pitch, m.yaw)
        check_within(_RATE_RADPS, m.rollspeed, m.pitchspeed, m.yawspeed)
        q = quat.from_euler(m.roll, m.pitch, m.yaw)
        rates = (m.rollspeed, m.pitchspeed, m.yawspeed)
        self.attitudes.add(Attitude(time_ns, m.roll, m.pitch, m.yaw, q, rates))

    def _attitude_quaternion(self, m: Any, time_ns: int) -> None:
        check_within(_RATE_RADPS, m.rollspeed, m.pitchspeed, m.yawspeed)
        q = quat.normalise((m.q1, m.q2, m.q3, m.q4))
        self.attitudes.add(attitude(time_ns, q, (m.rollspeed, m.pitchspeed, m.yawspeed)))

    def _gimbal_device(self, m: Any, time_ns: int) -> None:
        earth = gimbal_in_earth_frame(m.flags)
        q = quat.normalise(m.q)
        device = (m.get_srcComponent(), getattr(m, "gimbal_device_id", 0))
        self.gimbals.add(GimbalSample(time_ns, q, earth, GIMBAL_SOURCES[0], device))

    def _mount_orientation(self, m: Any, time_ns: int) -> None:
        roll, pitch, yaw = (math.radians(a) for a in (m.roll, m.pitch, m.yaw))
        check_within(ANGLE_RAD, roll, pitch, yaw)
        q = quat.from_euler(roll, pitch, yaw)
        self.gimbals.add(GimbalSample(time_ns, q, False, GIMBAL_SOURCES[1]))

    def _mount_status(self, m: Any, time_ns: int) -> None:
        # pointing_a, b, c: pitch, roll, yaw in centidegrees, yaw from the vehicle's nose.
        pitch, roll, yaw = (
            math.radians(0.01 * a) for a in (m.pointing_a, m.pointing_b, m.pointing_c)
        )
        check_within(ANGLE_RAD, roll, pitch, yaw)
        q = quat.from_euler(roll, pitch, yaw)
        self.gimbals.add(GimbalSample(time_ns, q, False, GIMBAL_SOURCES[2]))

    def _camera_settings(self, m: Any, time_ns: int) -> None:
        level = float(m.zoomLevel)
        if math.isfinite(level):
            check_within(_ZOOM_PERCENT, level)
        self.zooms.add_level(time_ns, m.get_srcComponent(), level if level >= 0.0 else math.nan)

    def _local_position(self, m: Any, time_ns: int) -> None:
        check_within(_DISTANCE_M, m.x, m.y, m.z)
        check_within(_SPEED_MPS, m.vx, m.vy, m.vz)
        self.locals.add(VectorSample(time_ns, (m.x, m.y, m.z)))
        self.state = replace(
            self.state,
            local_position_ned=(m.x, m.y, m.z),
            local_velocity_ned=(m.vx, m.vy, m.vz),
            local_time_ns=time_ns,
        )

    def _global_position(self, m: Any, time_ns: int) -> None:
        if m.lat == 0 and m.lon == 0:
            return  # what firmwares send before they have a position
        check_place(m.lat, m.lon)
        _check_heights(m.alt, m.relative_alt)
        place = (m.lat * 1e-7, m.lon * 1e-7, m.alt * 1e-3)
        self.globals.add(VectorSample(time_ns, place))
        self.state = replace(
            self.state,
            latitude_deg=place[0],
            longitude_deg=place[1],
            altitude_amsl_m=place[2],
            altitude_relative_m=m.relative_alt * 1e-3,
            position_time_ns=time_ns,
        )

    def _ekf_status(self, m: Any, _: int) -> None:
        # Test ratios of ArduPilot or PX4, whose flags share their first bits.
        is_px4 = m.get_type() == "ESTIMATOR_STATUS"
        ratio = m.pos_horiz_ratio if is_px4 else m.pos_horiz_variance
        variance = ratio if math.isfinite(ratio) else None  # the estimator does not know it
        self.state = replace(self.state, ekf_flags=m.flags, ekf_horizontal_variance=variance)

    def _gps(self, m: Any, time_ns: int) -> None:
        fixed = m.fix_type >= _FIX_3D
        if fixed:
            # A receiver that claims a fix where there is no place is none: its report is not heard
            # at all, and GNSS counts as gone once no better one comes.
            check_place(m.lat, m.lon)
            if m.lat == 0 and m.lon == 0:
                raise ValueError("a 3D fix at 0, 0")
            _check_heights(m.alt)
        accuracy = getattr(m, "h_acc", 0)
        height = getattr(m, "alt_ellipsoid", 0)  # an extension: 0 where it is not sent
        self.state = replace(
            self.state,
            gps_fix_type=m.fix_type,
            gps_latitude_deg=m.lat * 1e-7 if fixed else None,
            gps_longitude_deg=m.lon * 1e-7 if fixed else None,
            gps_altitude_amsl_m=m.alt * 1e-3 if fixed else None,
            gps_height_m=height * 1e-3 if fixed and height and _is_height(height) else None,
            gps_h_accuracy_m=accuracy * 1e-3 if 0 < accuracy <= _ACCURACY_MM else None,
            gps_time_ns=time_ns,
        )

    def _rc(self, m: Any, _: int) -> None:
        channels = tuple(getattr(m, f"chan{i}_raw") for i in range(1, 19))
        self.state = replace(self.state, rc_channels_us=channels)

    def _raw_imu(self, m: Any, time_ns: int) -> None:
        raw = (m.xacc, m.yacc, m.zacc, m.xgyro, m.ygyro, m.zgyro)
        if any(abs(value) >= _SATURATED for value in raw):
            raise ValueError(f"{raw}: saturated")
        force = (_MILLI_G * m.xacc, _MILLI_G * m.yacc, _MILLI_G * m.zacc)
        rates = (1e-3 * m.xgyro, 1e-3 * m.ygyro, 1e-3 * m.zgyro)
        self.inertial.add(InertialSample(time_ns, force, rates))

    def _highres_imu(self, m: Any, time_ns: int) -> None:
        force, rates = (m.xacc, m.yacc, m.zacc), (m.xgyro, m.ygyro, m.zgyro)
        check_within(_FORCE_MPS2, *force)
        check_within(_RATE_RADPS, *rates)
        self.inertial.add(InertialSample(time_ns, force, rates))

    def _pressure(self, m: Any, time_ns: int) -> None:
        if not _PRESSURE_HPA[0] <= m.press_abs <= _PRESSURE_HPA[1]:
            raise ValueError(f"{m.press_abs} hPa is no pressure of air")
        altitude = 44_330.77 * (1.0 - (m.press_abs / _SEA_LEVEL_HPA) ** 0.190263)
        self.state = replace(self.state, pressure_altitude_m=altitude, pressure_time_ns=time_ns)

    def _distance(self, m: Any, time_ns: int) -> None:
        """Process DISTANCE_SENSOR of a sensor that looks down. A value out of the sensor's own
        range, or marked as invalid, is ignored, and the previous one ages. Of two sensors the first
        one is used as long as it measures, because alternating distances would look like steps of
        the ground.
        """
        in_range = max(m.min_distance, 1) <= m.current_distance < m.max_distance
        invalid = getattr(m, "signal_quality", 0) == _INVALID_SIGNAL
        if m.orientation == mavlink.MAV_SENSOR_ROTATION_PITCH_270 and in_range and not invalid:
            measured_ns = self.state.rangefinder_time_ns
            if self._ranger not in (None, m.id) and time_ns - measured_ns < _GONE_NS:
                return
            self._ranger = m.id
            self.state = replace(
                self.state,
                rangefinder_m=m.current_distance * 1e-2,
                rangefinder_time_ns=time_ns,
            )


def boot_time_ns(message: Any) -> int | None:
    """The sender's time since boot in a message, ns; None if the message has none."""
    boot_ms = getattr(message, "time_boot_ms", None)
    if boot_ms is not None:
        return int(boot_ms) * 1_000_000
    if message.get_type() in ("RAW_IMU", "HIGHRES_IMU"):
        return int(message.time_usec) * 1000
    return None


def check_place(latitude_e7: int, longitude_e7: int) -> None:
    """ValueError for impossible coordinates in 1e-7 degrees."""
    if abs(latitude_e7) > 900_000_000 or abs(longitude_e7) > 1_800_000_000:
        raise ValueError(f"no place on Earth: {latitude_e7}, {longitude_e7}")


def _is_height(height_mm: int) -> bool:
    return _HEIGHTS_MM[0] <= height_mm <= _HEIGHTS_MM[1]


def _check_heights(*heights_mm: int) -> None:
    if not all(_is_height(height) for height in heights_mm):
        raise ValueError(f"{heights_mm} mm: no height of an aircraft")


def check_within(limit: float, *values: float) -> None:
    """ValueError for a value that is not finite, or beyond +-limit."""
    if not all(abs(value) <= limit for value in values):  # NaN is within nothing
        raise ValueError(f"{values}: not finite, or beyond {limit:g}")


_HANDLERS = {
    "HEARTBEAT": VehicleReadings._heartbeat,
    "AUTOPILOT_VERSION": VehicleReadings._version,
    "ATTITUDE": VehicleReadings._attitude_euler,
    "ATTITUDE_QUATERNION": VehicleReadings._attitude_quaternion,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": VehicleReadings._gimbal_device,
    "MOUNT_ORIENTATION": VehicleReadings._mount_orientation,
    "MOUNT_STATUS": VehicleReadings._mount_status,
    "CAMERA_SETTINGS": VehicleReadings._camera_settings,
    "LOCAL_POSITION_NED": VehicleReadings._local_position,
    "GLOBAL_POSITION_INT": VehicleReadings._global_position,
    "EKF_STATUS_REPORT": VehicleReadings._ekf_status,
    "ESTIMATOR_STATUS": VehicleReadings._ekf_status,
    "GPS_RAW_INT": VehicleReadings._gps,
    "RC_CHANNELS": VehicleReadings._rc,
    "RAW_IMU": VehicleReadings._raw_imu,
    "HIGHRES_IMU": VehicleReadings._highres_imu,
    "SCALED_PRESSURE": VehicleReadings._pressure,
    "DISTANCE_SENSOR": VehicleReadings._distance,
}
MESSAGES_IN: tuple[str, ...] = tuple(_HANDLERS)
