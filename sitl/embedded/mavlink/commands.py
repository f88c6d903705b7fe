"""Handles MAVLink messages addressed to the vehicle."""

from __future__ import annotations

from collections.abc import Callable
from math import degrees, isnan, radians
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.aircraft import Aircraft
from sitl.embedded.control.mode import Mode
from sitl.embedded.ekf.injection import Clock
from sitl.embedded.mavlink.server import SerialPort
from sitl.embedded.mavlink.telemetry import TelemetryBuilder
from sitl.embedded.physics.gimbal import FLAG_NEUTRAL, FLAG_YAW_LOCK
from sitl.embedded.severity import INFO, WARNING
from sitl.geodesy import Location

ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4  # MAV_RESULT
_GLOBAL_FRAMES_RELATIVE = (3, 6)
_GLOBAL_FRAMES = (0, 5, *_GLOBAL_FRAMES_RELATIVE)

Handler = Callable[[SerialPort, Any], None]
CommandHandler = Callable[[SerialPort, Any], int]


def location_of(
    home: Location | None, frame: int, x: int, y: int, altitude: float
) -> Location | None:
    """Location of a message's coordinates (degrees * 1e7, m) in a global MAV_FRAME. None for other
    frames, or without home.
    """
    if frame not in _GLOBAL_FRAMES or home is None:
        return None
    base = home.altitude_m if frame in _GLOBAL_FRAMES_RELATIVE else 0.0
    return Location(x / 1e7, y / 1e7, base + altitude)


_IGNORE_POSITION, _IGNORE_YAW = 7, 1 << 10
_SET_GLOBAL_ORIGIN = 611  # MAV_CMD_DO_SET_GLOBAL_ORIGIN, newer than pymavlink's dialect


class NavigationCommands:
    """Handlers by message name and by command number."""

    def __init__(self, vehicle: Aircraft) -> None:
        self._vehicle = vehicle
        self.messages: dict[str, Handler] = {
            "SET_GPS_GLOBAL_ORIGIN": self._set_origin_message,
            "SET_POSITION_TARGET_GLOBAL_INT": self._target_global,
            "MISSION_SET_CURRENT": self._mission_set_current,
        }
        m = mavlink
        self.commands: dict[int, CommandHandler] = {
            m.MAV_CMD_NAV_TAKEOFF: self._takeoff,
            _SET_GLOBAL_ORIGIN: self._set_origin,
            m.MAV_CMD_DO_SET_HOME: self._set_home,
            m.MAV_CMD_SET_EKF_SOURCE_SET: self._set_source,
            m.MAV_CMD_EXTERNAL_POSITION_ESTIMATE: self._external_position,
            m.MAV_CMD_MISSION_START: self._mission_start,
            m.MAV_CMD_DO_SET_MISSION_CURRENT: self._set_current,
            m.MAV_CMD_CONDITION_YAW: self._condition_yaw,
            m.MAV_CMD_DO_CHANGE_SPEED: self._change_speed,
            m.MAV_CMD_DO_REPOSITION: self._reposition,
        }

    def _takeoff(self, _link: SerialPort, command: Any) -> int:
        height = command.z if command.get_type() == "COMMAND_INT" else command.param7
        return ACCEPTED if self._vehicle.modes.takeoff(height) else FAILED

    def _set_origin(self, _link: SerialPort, command: Any) -> int:
        if command.get_type() != "COMMAND_INT":
            return UNSUPPORTED
        return self._new_origin(command.x, command.y, command.z)

    def _set_origin_message(self, _link: SerialPort, message: Any) -> None:
        self._new_origin(message.latitude, message.longitude, message.altitude / 1000.0)

    def _new_origin(self, latitude_e7: int, longitude_e7: int, altitude_m: float) -> int:
        if not (abs(latitude_e7) <= 900_000_000 and abs(longitude_e7) <= 1_800_000_000):
            return DENIED
        location = Location(latitude_e7 / 1e7, longitude_e7 / 1e7, altitude_m)
        return ACCEPTED if self._vehicle.estimator.set_origin(location) else FAILED

    def _set_home(self, _link: SerialPort, command: Any) -> int:
        v = self._vehicle
        if v.estimator.origin is None:
            return FAILED
        if command.param1 == 1:
            if v.estimator.location is None:
                return FAILED
            v.modes.home = v.estimator.location
        elif command.get_type() == "COMMAND_INT":
            v.modes.home = Location(command.x / 1e7, command.y / 1e7, command.z)
        else:
            return UNSUPPORTED
        return ACCEPTED

    def _set_source(self, _link: SerialPort, command: Any) -> int:
        source = int(command.param1)
        if source not in (1, 2, 3):
            return DENIED
        self._vehicle.use_source(source)
        return ACCEPTED

    def _external_position(self, _link: SerialPort, command: Any) -> int:
        v = self._vehicle
        if command.get_type() != "COMMAND_INT" or v.estimator.origin is None:
            return FAILED
        north, east, _ = v.estimator.origin.ned_of(Location(command.x / 1e7, command.y / 1e7, 0.0))
        sigma = command.param3 if command.param3 > 0 else 10.0
        return ACCEPTED if v.estimator.sources.force_position(north, east, sigma) else FAILED

    def _mission_start(self, _link: SerialPort, _command: Any) -> int:
        return ACCEPTED if self._vehicle.modes.start_mission() else FAILED

    def _set_current(self, _link: SerialPort, command: Any) -> int:
        return ACCEPTED if self._vehicle.modes.start_mission(int(command.param1)) else FAILED

    def _mission_set_current(self, _link: SerialPort, message: Any) -> None:
        self._vehicle.modes.start_mission(message.seq)

    def _condition_yaw(self, _link: SerialPort, command: Any) -> int:
        self._vehicle.modes.condition_yaw(command.param1, command.param3, bool(command.param4))
        return ACCEPTED

    def _change_speed(self, _link: SerialPort, command: Any) -> int:
        return ACCEPTED if self._vehicle.modes.change_speed(command.param2) else FAILED

    def _reposition(self, _link: SerialPort, command: Any) -> int:
        if command.get_type() != "COMMAND_INT":
            return UNSUPPORTED
        v = self._vehicle
        location = location_of(v.modes.home, command.frame, command.x, command.y, command.z)
        if location is None:
            return DENIED
        if v.modes.mode is not Mode.GUIDED and not (
            int(command.param2) & 1 and v.modes.set_mode(Mode.GUIDED)
        ):
            return DENIED
        yaw = None if isnan(command.param4) else radians(command.param4)
        return ACCEPTED if v.modes.go_to(location, yaw) else DENIED

    def _target_global(self, _link: SerialPort, message: Any) -> None:
        """Handle SET_POSITION_TARGET_GLOBAL_INT: fly to its position. Velocities are ignored."""
        modes, frame = self._vehicle.modes, message.coordinate_frame
        location = location_of(modes.home, frame, message.lat_int, message.lon_int, message.alt)
        if location is not None and not message.type_mask & _IGNORE_POSITION:
            modes.go_to(location, None if message.type_mask & _IGNORE_YAW else message.yaw)


class GimbalCommands:
    """Handlers by message name and by command number."""

    def __init__(self, vehicle: Aircraft) -> None:
        self._vehicle = vehicle
        self.messages: dict[str, Handler] = {
            "GIMBAL_MANAGER_SET_PITCHYAW": self._gimbal_pitchyaw_message,
        }
        m = mavlink
        self.commands: dict[int, CommandHandler] = {
            m.MAV_CMD_DO_MOUNT_CONTROL: self._mount_control,
            m.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW: self._gimbal_pitchyaw,
            m.MAV_CMD_DO_SET_ROI_LOCATION: self._roi,
            m.MAV_CMD_DO_SET_ROI: self._roi,
            m.MAV_CMD_DO_SET_ROI_NONE: self._roi_none,
        }

    def _mount_control(self, _link: SerialPort, command: Any) -> int:
        gimbal = self._vehicle.gimbal
        mode = int(command.z if command.get_type() == "COMMAND_INT" else command.param7)
        if not gimbal.fitted:
            return FAILED
        if mode == 2:  # MAV_MOUNT_MODE_MAVLINK_TARGETING
            gimbal.point(command.param1, command.param3, yaw_locked=False)
        elif mode in (0, 1):
            gimbal.neutral()
        else:
            return FAILED
        return ACCEPTED

    def _gimbal_pitchyaw(self, _link: SerialPort, command: Any) -> int:
        flags = int(command.x if command.get_type() == "COMMAND_INT" else command.param5)
        return self._point(command.param1, command.param2, command.param3, command.param4, flags)

    def _gimbal_pitchyaw_message(self, _link: SerialPort, message: Any) -> None:
        self._point(
            degrees(message.pitch),
            degrees(message.yaw),
            degrees(message.pitch_rate),
            degrees(message.yaw_rate),
            message.flags,
        )

    def _point(
        self, pitch: float, yaw: float, pitch_rate: float, yaw_rate: float, flags: int
    ) -> int:
        gimbal = self._vehicle.gimbal
        if not gimbal.fitted:
            return FAILED
        locked = bool(flags & FLAG_YAW_LOCK)
        if flags & FLAG_NEUTRAL:
            gimbal.neutral()
        elif not (isnan(pitch) or isnan(yaw)):
            gimbal.point(pitch, yaw, yaw_locked=locked)
        elif not (isnan(pitch_rate) or isnan(yaw_rate)):
            gimbal.rotate(pitch_rate, yaw_rate, yaw_locked=locked)
        else:
            return FAILED
        return ACCEPTED

    def _roi(self, _link: SerialPort, command: Any) -> int:
        v = self._vehicle
        if not v.gimbal.fitted or command.get_type() != "COMMAND_INT":
            return FAILED
        location = location_of(
            self._vehicle.modes.home, command.frame, command.x, command.y, command.z
        )
        if location is None:
            return FAILED
        v.gimbal.look_at(location)
        return ACCEPTED

    def _roi_none(self, _link: SerialPort, _command: Any) -> int:
        self._vehicle.gimbal.look_at(None)
        return ACCEPTED


class ParameterCommands:
    """Handlers by message name."""

    def __init__(self, vehicle: Aircraft) -> None:
        self._vehicle = vehicle
        self.messages: dict[str, Handler] = {
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
        }

    def _param_value(self, name: str, index: int) -> Any:
        p = self._vehicle.parameters
        return mavlink.MAVLink_param_value_message(
            name.encode(), p.encode_value(name), p.type_of(name), len(p), index
        )

    def _param_list(self, link: SerialPort, _message: Any) -> None:
        for index, name in enumerate(self._vehicle.parameters):
            link.send(self._param_value(name, index))

    def _param_read(self, link: SerialPort, message: Any) -> None:
        p = self._vehicle.parameters
        name = _text(message.param_id)
        found = name if message.param_index < 0 else p.name_at(message.param_index)
        if found is not None and found in p:
            link.send(self._param_value(found, p.index_of(found)))

    def _param_set(self, _link: SerialPort, message: Any) -> None:
        v = self._vehicle
        name = _text(message.param_id)
        p = v.parameters
        if name in p and p.set(name, p.decode_value(name, message.param_value)):
            # ArduPilot tells every link of a change, with an index of 65535.
            v.server.broadcast(self._param_value(name, 65535))


def _text(value: str | bytes) -> str:
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else value
    return text.rstrip("\0")


_FORCE_ARM = 21196.0


class Commands:
    """Dispatches incoming messages and commands."""

    def __init__(self, vehicle: Aircraft, telemetry: TelemetryBuilder) -> None:
        self._vehicle, self._telemetry = vehicle, telemetry
        navigation, gimbal = NavigationCommands(vehicle), GimbalCommands(vehicle)
        self._messages: dict[str, Handler] = {
            **navigation.messages,
            **gimbal.messages,
            **ParameterCommands(vehicle).messages,
            "COMMAND_LONG": self._command,
            "COMMAND_INT": self._command,
            "SET_MODE": self._set_mode_message,
            "VISION_POSITION_ESTIMATE": self._vision,
            "GLOBAL_VISION_POSITION_ESTIMATE": self._vision,
            "ODOMETRY": self._odometry,
            "VISION_POSITION_DELTA": self._position_delta,
            "GPS_INPUT": self._gps_input,
            "TIMESYNC": self._timesync,
            "REQUEST_DATA_STREAM": self._data_stream,
        }
        m = mavlink
        self._commands: dict[int, CommandHandler] = {
            **navigation.commands,
            **gimbal.commands,
            m.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            m.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            m.MAV_CMD_NAV_LAND: lambda _l, _c: self._mode(Mode.LAND),
            m.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _l, _c: self._mode(Mode.RTL),
            m.MAV_CMD_DO_SET_MODE: self._set_mode,
            m.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            m.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            m.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._request_version,
        }

    def handle(self, link: SerialPort, message: Any) -> None:
        """Act on one message."""
        kind = message.get_type()
        handler = self._messages.get(kind)
        if handler is not None:
            handler(link, message)
        elif kind.startswith("MISSION_") and self._vehicle.mission.handle(message, link):
            self._vehicle.modes.mission_index = 0

    # --- commands ----------------------------------------------------------------------------

    def _command(self, link: SerialPort, message: Any) -> None:
        handler = self._commands.get(message.command)
        result = handler(link, message) if handler else UNSUPPORTED
        link.send(
            mavlink.MAVLink_command_ack_message(
                message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )
        )

    def _arm(self, _link: SerialPort, command: Any) -> int:
        v = self._vehicle
        forced = command.param2 == _FORCE_ARM
        if command.param1 == 0:
            if v.modes.flying and not v.modes.on_ground and not forced:
                return FAILED
            v.modes.disarm()
            return ACCEPTED
        if v.modes.armed:
            return ACCEPTED
        if not forced and v.report_failures("Arm"):
            return FAILED
        v.modes.arm()
        v.notify(INFO, "Arming motors")
        return ACCEPTED

    def _reboot(self, _link: SerialPort, command: Any) -> int:
        if command.param1 != 1 or self._vehicle.modes.armed:
            return FAILED
        self._vehicle.reboot_ordered = True
        return ACCEPTED

    def _mode(self, mode: Mode) -> int:
        return ACCEPTED if self._vehicle.modes.set_mode(mode) else FAILED

    def _set_mode(self, _link: SerialPort, command: Any) -> int:
        try:
            mode = Mode(int(command.param2))
        except ValueError:
            return FAILED
        return self._mode(mode)

    def _set_mode_message(self, _link: SerialPort, message: Any) -> None:
        try:
            mode = Mode(message.custom_mode)
        except ValueError:
            self._vehicle.notify(WARNING, f"No such mode {message.custom_mode}")
            return
        self._mode(mode)

    def _set_interval(self, link: SerialPort, command: Any) -> int:
        message_id, interval_us = int(command.param1), command.param2
        if not self._telemetry.can_send(message_id):
            return FAILED
        if interval_us < 0:
            link.set_interval(message_id, None)
        elif interval_us > 0:
            link.set_interval(message_id, max(interval_us / 1e6, 0.01))
        return ACCEPTED

    def _request_message(self, link: SerialPort, command: Any) -> int:
        sent = self._telemetry.send(link, int(command.param1))
        return ACCEPTED if sent else FAILED

    def _request_version(self, link: SerialPort, _command: Any) -> int:
        self._telemetry.send(link, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        return ACCEPTED

    # --- injection ---------------------------------------------------------------------------

    def _clock(self, link: SerialPort) -> Clock:
        """Of the link's sender."""
        return link.jitter

    def _vision(self, link: SerialPort, message: Any) -> None:
        self._vehicle.injection.vision(message, self._clock(link), self._vehicle.time_ms)

    def _odometry(self, link: SerialPort, message: Any) -> None:
        self._vehicle.injection.odometry(message, self._clock(link), self._vehicle.time_ms)

    def _position_delta(self, _link: SerialPort, message: Any) -> None:
        self._vehicle.injection.position_delta(message, self._vehicle.time_ms)

    def _gps_input(self, link: SerialPort, message: Any) -> None:
        self._vehicle.injection.gps_input(message, self._clock(link), self._vehicle.time_ms)

    def _timesync(self, link: SerialPort, message: Any) -> None:
        if message.tc1 == 0:
            link.send(
                mavlink.MAVLink_timesync_message(self._vehicle.time_ms * 1_000_000, message.ts1)
            )

    # --- streams -----------------------------------------------------------------------------

    def _data_stream(self, link: SerialPort, message: Any) -> None:
        """Handle REQUEST_DATA_STREAM: groups of messages (status, attitude, position)."""
        groups = {
            2: (mavlink.MAVLINK_MSG_ID_SYS_STATUS,),
            6: (
                mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
                mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
            ),
            10: (mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_SIM_STATE),
            12: (mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,),
        }
        wanted = (
            groups.values()
            if message.req_stream_id == 0
            else [groups.get(message.req_stream_id, ())]
        )
        rate = message.req_message_rate if message.start_stop else 0
        for group in wanted:
            for message_id in group:
                link.set_interval(message_id, 1.0 / rate if rate > 0 else None)
