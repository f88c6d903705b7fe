"""The messages that the vehicle streams or sends on request."""

from __future__ import annotations

from collections.abc import Callable
from math import degrees, nan, pi
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.aircraft import Aircraft
from sitl.embedded.ekf.estimator import EkfFlags
from sitl.embedded.mavlink.server import SerialPort
from sitl.embedded.physics.dynamics import GRAVITY
from sitl.embedded.physics.rotation import euler
from sitl.geodesy import Location

FIRMWARE_VERSION = (4, 7, 0, 0)  # major, minor, patch, FIRMWARE_VERSION_TYPE_DEV
_TYPE_QUADROTOR, _AUTOPILOT_ARDUPILOT = 2, 3
_MODE_CUSTOM, _MODE_ARMED = 1, 128
_STATE_STANDBY, _STATE_ACTIVE = 3, 4
_SENSOR_GPS, _SENSOR_VISION, _SENSOR_AHRS, _SENSOR_PREARM = 1 << 5, 1 << 7, 1 << 21, 1 << 28
_SENSORS_ALWAYS = 0b1111 | 1 << 10 | 1 << 11 | 1 << 15
_CAPABILITIES = 2 | 4 | 8 | 128 | 256 | 8192  # float params, int missions and commands, MAVLink 2

# What every link gets without asking, in Hz: as ArduPilot SITL, nothing but the heartbeat.
DEFAULT_STREAMS = {mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0}


class TelemetryBuilder:
    """Builds telemetry messages from the vehicle's state.

    Above 200 lines: one short method for each of its messages, and their table.
    """

    _autopilot, _firmware, _capabilities = _AUTOPILOT_ARDUPILOT, FIRMWARE_VERSION, _CAPABILITIES

    def __init__(self, vehicle: Aircraft) -> None:
        self._vehicle = vehicle
        m = mavlink
        self._builders: dict[int, Callable[[], Any]] = {
            m.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            m.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            m.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            m.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude_quaternion,
            m.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position,
            m.MAVLINK_MSG_ID_RAW_IMU: self._raw_imu,
            m.MAVLINK_MSG_ID_SCALED_PRESSURE: self._pressure,
            m.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position,
            m.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps_raw,
            m.MAVLINK_MSG_ID_VFR_HUD: self._vfr_hud,
            m.MAVLINK_MSG_ID_EKF_STATUS_REPORT: self._ekf_status,
            m.MAVLINK_MSG_ID_SIM_STATE: self._sim_state,
            m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._origin,
            m.MAVLINK_MSG_ID_HOME_POSITION: self._home,
            m.MAVLINK_MSG_ID_MISSION_CURRENT: self._mission_current,
            m.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._version,
            m.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: self._gimbal_attitude,
            m.MAVLINK_MSG_ID_GIMBAL_MANAGER_STATUS: self._gimbal_manager_status,
            m.MAVLINK_MSG_ID_GIMBAL_MANAGER_INFORMATION: self._gimbal_manager_information,
        }

    def can_send(self, message_id: int) -> bool:
        """Whether the vehicle has this message."""
        return message_id in self._builders

    def message(self, message_id: int) -> Any | None:
        """Build one message now; None if it is not available."""
        builder = self._builders.get(message_id)
        return builder() if builder else None

    def stream(self) -> None:
        """Send on each link the streamed messages that are due."""
        now = self._vehicle.time_s
        built: dict[int, Any] = {}
        for link in self._vehicle.server.links:
            for message_id in link.due_messages(now):
                if message_id not in built:
                    built[message_id] = self.message(message_id)
                if built[message_id] is not None:
                    link.send(built[message_id])

    def send(self, link: SerialPort, message_id: int) -> bool:
        """Build one message from the vehicle's present state and send it on one link; returns
        False, and sends nothing, if the message is not available.
        """
        message = self.message(message_id)
        if message is not None:
            link.send(message)
        return message is not None

    # --- system ------------------------------------------------------------------------------

    def _heartbeat(self) -> Any:
        modes = self._vehicle.modes
        return mavlink.MAVLink_heartbeat_message(
            _TYPE_QUADROTOR,
            self._autopilot,
            _MODE_CUSTOM | (_MODE_ARMED if modes.armed else 0),
            self._mode_number(),
            _STATE_ACTIVE if modes.armed else _STATE_STANDBY,
            3,
        )

    def _mode_number(self) -> int:
        """HEARTBEAT's custom_mode."""
        return int(self._vehicle.modes.mode)

    def _sys_status(self) -> Any:
        v = self._vehicle
        gps = _SENSOR_GPS if v.parameters["GPS1_TYPE"] > 0 else 0
        vision = _SENSOR_VISION if v.parameters["VISO_TYPE"] > 0 else 0
        present = _SENSORS_ALWAYS | gps | vision | _SENSOR_AHRS | _SENSOR_PREARM
        healthy = _SENSORS_ALWAYS
        healthy |= gps if v.gps_healthy else 0
        healthy |= vision if v.injection.healthy(v.time_ms) else 0
        healthy |= _SENSOR_AHRS if EkfFlags.ATTITUDE in v.estimator.flags else 0
        healthy |= _SENSOR_PREARM if v.modes.armed or not v.arming_failures() else 0
        return mavlink.MAVLink_sys_status_message(
            present, present, healthy, 100, 12600, 1000, 100, 0, 0, 0, 0, 0, 0
        )

    def _version(self) -> Any:
        major, minor, patch, kind = self._firmware
        version = major << 24 | minor << 16 | patch << 8 | kind
        return mavlink.MAVLink_autopilot_version_message(
            self._capabilities, version, 0, 0, 0, b"embedded", b"\0" * 8, b"\0" * 8, 0, 0, 0
        )

    # --- navigation --------------------------------------------------------------------------

    def _rates(self) -> tuple[float, float, float]:
        p, q, r = (float(c) for c in self._vehicle.truth[10:13])
        return p, q, r

    def _attitude(self) -> Any:
        v = self._vehicle
        angles = euler(v.estimator.output[0:4])
        return mavlink.MAVLink_attitude_message(v.time_ms, *angles, *self._rates())

    def _attitude_quaternion(self) -> Any:
        v = self._vehicle
        q = (float(c) for c in v.estimator.output[0:4])
        return mavlink.MAVLink_attitude_quaternion_message(v.time_ms, *q, *self._rates())

    def _raw_imu(self) -> Any:
        """Mean of the last tick, as ArduPilot's filtered sample: milli-g and mrad/s, body axes."""
        v = self._vehicle
        rates = (round(1000.0 * float(c)) for c in v.angular_rate)
        forces = (round(1000.0 * float(c) / GRAVITY) for c in v.specific_force)
        return mavlink.MAVLink_raw_imu_message(v.time_ms * 1000, *forces, *rates, 0, 0, 0)

    def _pressure(self) -> Any:
        """Of the standard atmosphere at the barometer's height."""
        v = self._vehicle
        altitude = v.launch.altitude_m + v.barometer_m
        pressure = 1013.25 * (1.0 - altitude / 44_330.77) ** 5.25588
        return mavlink.MAVLink_scaled_pressure_message(v.time_ms, pressure, 0.0, 2000)

    def _local_position(self) -> Any | None:
        v = self._vehicle
        if v.estimator.origin is None or EkfFlags.CONST_POS_MODE in v.estimator.flags:
            return None  # ArduPilot sends none without a position solution
        return mavlink.MAVLink_local_position_ned_message(
            v.time_ms, *v.estimator.position, *v.estimator.velocity
        )

    def _global_position(self) -> Any:
        v = self._vehicle
        known = v.estimator.location
        here = known or Location(0.0, 0.0, 0.0)
        above = here.altitude_m - v.modes.home.altitude_m if v.modes.home and known else 0.0
        velocity = (round(c * 100) for c in v.estimator.velocity)
        return mavlink.MAVLink_global_position_int_message(
            v.time_ms,
            *_scaled(here),
            round(above * 1000),
            *velocity,
            self._heading_centidegrees(),
        )

    def _heading_centidegrees(self) -> int:
        yaw = euler(self._vehicle.estimator.output[0:4])[2]
        return round(degrees(yaw % (2 * pi)) * 100) % 36000

    def _gps_raw(self) -> Any:
        v = self._vehicle
        injected, sample = v.injection.gps, v.gps_sample
        stamp = v.time_ms * 1000
        if not v.gps_has_fix or (injected is None and sample is None):
            kind = 1 if v.parameters["GPS1_TYPE"] > 0 else 0
            return mavlink.MAVLink_gps_raw_int_message(
                stamp, kind, 0, 0, 0, 9999, 65535, 0, 65535, 0
            )
        if injected is not None and v.parameters["GPS1_TYPE"] == 14:
            where = Location(injected.latitude_deg, injected.longitude_deg, injected.altitude_m)
            satellites, hdop = injected.satellites, injected.hdop
            accuracy, kind = injected.horizontal_accuracy, 3
        else:
            if sample is None:
                return None
            where = v.launch.offset(*(float(c) for c in sample.position))
            satellites, hdop = sample.satellites, 1.2
            accuracy, kind = sample.horizontal_accuracy, 6
        return mavlink.MAVLink_gps_raw_int_message(
            stamp,
            kind,
            *_scaled(where),
            round(hdop * 100),
            65535,
            0,
            65535,
            satellites,
            0,
            round(accuracy * 1000),
        )

    def _vfr_hud(self) -> Any:
        v = self._vehicle
        n, e, d = v.estimator.velocity
        speed = (n * n + e * e) ** 0.5
        here = v.estimator.location
        throttle = round(float(v.truth[13:17].sum()) / 64.0 * 100)
        return mavlink.MAVLink_vfr_hud_message(
            speed,
            speed,
            self._heading_centidegrees() // 100,
            throttle,
            here.altitude_m if here else 0.0,
            -d,
        )

    def _ekf_status(self) -> Any:
        estimator = self._vehicle.estimator
        velocity, position, height, compass = estimator.variances
        return mavlink.MAVLink_ekf_status_report_message(
            int(estimator.flags), velocity, position, height, compass, 0.0, 0.0
        )

    def _sim_state(self) -> Any:
        """Ground truth. The float latitude and longitude are scaled by 1e7, as ArduPilot's are."""
        v = self._vehicle
        where, x = v.true_location, v.truth
        q = [float(c) for c in x[6:10]]
        latitude, longitude, _ = _scaled(where)
        return mavlink.MAVLink_sim_state_message(
            *q,
            *euler(x[6:10]),
            0.0,
            0.0,
            0.0,
            *self._rates(),
            float(latitude),
            float(longitude),
            where.altitude_m,
            0.0,
            0.0,
            *(float(c) for c in x[3:6]),
            latitude,
            longitude,
        )

    def _origin(self) -> Any | None:
        origin = self._vehicle.estimator.origin
        if origin is None:
            return None
        return mavlink.MAVLink_gps_global_origin_message(
            *_scaled(origin), self._vehicle.time_ms * 1000
        )

    def _home(self) -> Any | None:
        v = self._vehicle
        home = v.modes.home
        if home is None or v.estimator.origin is None:
            return None
        return mavlink.MAVLink_home_position_message(
            *_scaled(home),
            *v.estimator.origin.ned_of(home),
            [1.0, 0.0, 0.0, 0.0],
            0.0,
            0.0,
            0.0,
            v.time_ms * 1000,
        )

    def _mission_current(self) -> Any:
        v = self._vehicle
        return mavlink.MAVLink_mission_current_message(
            v.modes.mission_index, max(0, len(v.mission.items) - 1)
        )

    # --- gimbal ------------------------------------------------------------------------------

    def _gimbal_attitude(self) -> Any | None:
        v = self._vehicle
        if not v.gimbal.fitted:
            return None
        roll, pitch, _ = euler(v.estimator.output[0:4])
        q = [float(c) for c in v.gimbal.reported(roll, pitch)]
        return mavlink.MAVLink_gimbal_device_attitude_status_message(
            0, 0, v.time_ms, v.gimbal.flags, q, nan, nan, nan, 0, nan, nan, 1
        )

    def _gimbal_manager_status(self) -> Any | None:
        v = self._vehicle
        if not v.gimbal.fitted:
            return None
        return mavlink.MAVLink_gimbal_manager_status_message(
            v.time_ms, v.gimbal.flags, 1, 0, 0, 0, 0
        )

    def _gimbal_manager_information(self) -> Any | None:
        v, p = self._vehicle, self._vehicle.parameters
        if not v.gimbal.fitted:
            return None
        limits = (
            p[f"MNT1_{axis}_{end}"] * pi / 180
            for axis in ("ROLL", "PITCH", "YAW")
            for end in ("MIN", "MAX")
        )
        capabilities = 1 | 2 | 8 | 16 | 64 | 256 | 1024 | 2048 | 65536 | 131072
        return mavlink.MAVLink_gimbal_manager_information_message(
            v.time_ms, capabilities, 1, *limits
        )


def _scaled(where: Location) -> tuple[int, int, int]:
    """Degrees * 1e7, degrees * 1e7 and millimetres, as messages carry them."""
    return (
        round(where.latitude_deg * 1e7),
        round(where.longitude_deg * 1e7),
        round(where.altitude_m * 1000),
    )
