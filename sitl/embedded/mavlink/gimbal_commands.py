"""Commands and messages that point the gimbal."""

from __future__ import annotations

from math import degrees, isnan
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.aircraft import Aircraft
from sitl.embedded.mavlink.handling import ACCEPTED, FAILED, CommandHandler, Handler, location_of
from sitl.embedded.mavlink.server import SerialPort
from sitl.embedded.physics.gimbal import FLAG_NEUTRAL, FLAG_YAW_LOCK


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
