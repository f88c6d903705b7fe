"""Navigation commands and messages: origin, home, source set, mission, guided targets."""

from __future__ import annotations

from math import isnan, radians
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.aircraft import Aircraft
from sitl.embedded.control.mode import Mode
from sitl.embedded.mavlink.handling import (
    ACCEPTED,
    DENIED,
    FAILED,
    UNSUPPORTED,
    CommandHandler,
    Handler,
    location_of,
)
from sitl.embedded.mavlink.server import SerialPort
from sitl.geodesy import Location

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
