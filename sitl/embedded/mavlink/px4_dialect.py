"""What PX4 sends and takes otherwise than ArduPilot."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.aircraft import Aircraft
from sitl.embedded.control.mode import Mode
from sitl.embedded.control.px4_modes import NUMBERS, custom_mode
from sitl.embedded.ekf.ekf2_injection import Px4PositionInput, RemoteClock
from sitl.embedded.ekf.injection import Clock
from sitl.embedded.mavlink.commands import ACCEPTED, FAILED, Commands
from sitl.embedded.mavlink.server import SerialPort
from sitl.embedded.mavlink.telemetry import TelemetryBuilder

FIRMWARE_VERSION = (1, 17, 0, 255)  # major, minor, patch, FIRMWARE_VERSION_TYPE_OFFICIAL
_AUTOPILOT_PX4 = 12
_SENSOR_VISION = 1 << 7
_FLAGS_SHARED = 0x3FF  # ESTIMATOR_STATUS_FLAGS that mean what EKF_STATUS_FLAGS do
_BYTEWISE, _MAVLINK2 = 16, 8192
_CAPABILITIES = 4 | 8 | 128 | 256 | _BYTEWISE | _MAVLINK2


class Px4Telemetry(TelemetryBuilder):
    """HEARTBEAT, ESTIMATOR_STATUS and HIGHRES_IMU instead of ArduPilot's."""

    _autopilot, _firmware, _capabilities = _AUTOPILOT_PX4, FIRMWARE_VERSION, _CAPABILITIES

    def __init__(self, vehicle: Aircraft) -> None:
        super().__init__(vehicle)
        m = mavlink
        del self._builders[m.MAVLINK_MSG_ID_EKF_STATUS_REPORT]
        del self._builders[m.MAVLINK_MSG_ID_RAW_IMU]
        self._builders[m.MAVLINK_MSG_ID_ESTIMATOR_STATUS] = self._estimator_status
        self._builders[m.MAVLINK_MSG_ID_HIGHRES_IMU] = self._highres_imu

    def _mode_number(self) -> int:
        return custom_mode(self._vehicle.modes.mode)

    def _sys_status(self) -> Any:
        """PX4 never sets the bit of vision."""
        message = super()._sys_status()
        message.onboard_control_sensors_present &= ~_SENSOR_VISION
        message.onboard_control_sensors_enabled &= ~_SENSOR_VISION
        message.onboard_control_sensors_health &= ~_SENSOR_VISION
        return message

    def _estimator_status(self) -> Any:
        v = self._vehicle
        velocity, position, height, compass = v.estimator.variances
        flags = int(v.estimator.flags) & _FLAGS_SHARED
        horizontal, vertical, _ = v.estimator.accuracy()
        return mavlink.MAVLink_estimator_status_message(
            v.time_ms * 1000,
            flags,
            velocity,
            position,
            height,
            compass,
            0.0,
            0.0,
            horizontal,
            vertical,
        )

    def _highres_imu(self) -> Any:
        v = self._vehicle
        force = (float(c) for c in v.specific_force)
        rates = (float(c) for c in v.angular_rate)
        unread = (0.0,) * 7  # fields_updated says so
        return mavlink.MAVLink_highres_imu_message(
            v.time_ms * 1000, *force, *rates, *unread, 0b111111
        )


class Px4Commands(Commands):
    """PX4's position messages, its modes, and the answers to the vehicle's own TIMESYNC."""

    def __init__(self, vehicle: Aircraft, telemetry: TelemetryBuilder) -> None:
        super().__init__(vehicle, telemetry)
        self._clocks: dict[str, RemoteClock] = defaultdict(RemoteClock)
        for name in ("GLOBAL_VISION_POSITION_ESTIMATE", "VISION_POSITION_DELTA", "GPS_INPUT"):
            del self._messages[name]
        self._messages["GLOBAL_POSITION_SENSOR"] = self._global_position
        del self._commands[mavlink.MAV_CMD_SET_EKF_SOURCE_SET]
        self._commands[mavlink.MAV_CMD_NAV_TAKEOFF] = self._takeoff

    def _set_mode(self, _link: SerialPort, command: Any) -> int:
        wanted = int(command.param2), int(command.param3)
        modes = [mode for mode, numbers in NUMBERS.items() if numbers == wanted]
        return self._mode(modes[0]) if modes else FAILED

    def _takeoff(self, _link: SerialPort, command: Any) -> int:
        """MAV_CMD_NAV_TAKEOFF with an altitude above mean sea level."""
        v = self._vehicle
        if v.modes.home is None or not v.modes.set_mode(Mode.GUIDED):
            return FAILED
        altitude = command.z if command.get_type() == "COMMAND_INT" else command.param7
        return ACCEPTED if v.modes.takeoff(altitude - v.modes.home.altitude_m) else FAILED

    def _timesync(self, link: SerialPort, message: Any) -> None:
        super()._timesync(link, message)
        if message.tc1 != 0:
            now_us = self._vehicle.time_ms * 1000
            self._clocks[link.name].add_exchange(message.tc1 // 1000, message.ts1 // 1000, now_us)

    def _clock(self, link: SerialPort) -> Clock:
        return self._clocks[link.name]

    def _global_position(self, link: SerialPort, message: Any) -> None:
        taken = self._vehicle.injection
        assert isinstance(taken, Px4PositionInput)
        taken.global_position(message, self._clock(link), self._vehicle.time_ms)
