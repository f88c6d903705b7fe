"""Mission storage and the MAVLink mission protocol (upload, download, clear)."""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.geodesy import Location

# MAV_MISSION_RESULT
ACCEPTED, UNSUPPORTED, NO_SPACE, _INVALID_PARAMETER_1, INVALID_SEQUENCE = 0, 3, 4, 6, 13
_MISSION_TYPE = 0  # MAV_MISSION_TYPE_MISSION
_MAX_ITEMS = 700
_RELATIVE_FRAMES = (3, 6)

TAKEOFF, WAYPOINT, LOITER_TIME, RTL, LAND = 22, 16, 19, 20, 21
CONDITION_YAW, CHANGE_SPEED, ROI_LOCATION, ROI_NONE = 115, 178, 195, 197
MOUNT_CONTROL, GIMBAL_PITCHYAW = 205, 1000
NAVIGATION = frozenset({TAKEOFF, WAYPOINT, LOITER_TIME, RTL, LAND})
SUPPORTED = NAVIGATION | {
    CONDITION_YAW,
    CHANGE_SPEED,
    ROI_LOCATION,
    ROI_NONE,
    MOUNT_CONTROL,
    GIMBAL_PITCHYAW,
}


class Reply(Protocol):
    """Sends answers on the link that asked."""

    def send(self, message: Any) -> None:
        """Send one message."""


@dataclass(frozen=True)
class StoredMissionItem:
    """One item as MISSION_ITEM_INT carries it; degrees and metres."""

    command: int
    frame: int
    parameters: tuple[float, float, float, float]
    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    @property
    def has_position(self) -> bool:
        """Whether latitude and longitude are given (0, 0 means here)."""
        return self.latitude_deg != 0.0 or self.longitude_deg != 0.0

    def location(self, here: Location, home: Location) -> Location:
        """The item's location; missing coordinates are taken from `here`."""
        base = home.altitude_m if self.frame in _RELATIVE_FRAMES else 0.0
        if self.has_position:
            return Location(self.latitude_deg, self.longitude_deg, base + self.altitude_m)
        return Location(here.latitude_deg, here.longitude_deg, base + self.altitude_m)


class MissionStore:
    """The vehicle's mission. Item 0 is home, as in ArduPilot, and is never flown."""

    def __init__(self) -> None:
        self.items: list[StoredMissionItem] = []
        self._incoming: list[StoredMissionItem] = []
        self._expected = 0
        self._peer = (0, 0)

    def handle(self, message: Any, reply: Reply) -> bool:
        """Answer a mission-protocol message on `reply`; True if it replaced the mission."""
        kind = message.get_type()
        self._peer = (message.get_srcSystem(), message.get_srcComponent())
        if getattr(message, "mission_type", _MISSION_TYPE) != _MISSION_TYPE:
            self._other_type(kind, message, reply)
            return False
        if kind == "MISSION_COUNT":
            return self._begin(message.count, reply)
        if kind in ("MISSION_ITEM_INT", "MISSION_ITEM"):
            return self._receive(message, reply)
        if kind == "MISSION_CLEAR_ALL":
            self.items = []
            self._acknowledge(ACCEPTED, reply)
            return True
        if kind == "MISSION_REQUEST_LIST":
            reply.send(mavlink.MAVLink_mission_count_message(*self._peer, len(self.items)))
        elif kind in ("MISSION_REQUEST_INT", "MISSION_REQUEST"):
            self._give(message.seq, reply)
        return False

    def _other_type(self, kind: str, message: Any, reply: Reply) -> None:
        """Answer a message about fences or rally points: the vehicle has none and accepts none."""
        if kind == "MISSION_REQUEST_LIST":
            reply.send(mavlink.MAVLink_mission_count_message(*self._peer, 0, message.mission_type))
        elif kind in ("MISSION_COUNT", "MISSION_CLEAR_ALL"):
            empty = kind == "MISSION_CLEAR_ALL" or message.count == 0
            result = ACCEPTED if empty else UNSUPPORTED
            reply.send(
                mavlink.MAVLink_mission_ack_message(*self._peer, result, message.mission_type)
            )

    def _begin(self, size: int, reply: Reply) -> bool:
        if size > _MAX_ITEMS:
            self._acknowledge(NO_SPACE, reply)
            return False
        self._incoming, self._expected = [], size
        if size == 0:
            self.items = []
            self._acknowledge(ACCEPTED, reply)
            return True
        self._request(0, reply)
        return False

    def _receive(self, message: Any, reply: Reply) -> bool:
        if self._expected == 0 or message.seq != len(self._incoming):
            if message.seq > len(self._incoming) or self._expected == 0:
                self._acknowledge(INVALID_SEQUENCE, reply)
            return False
        if message.seq > 0 and message.command not in SUPPORTED:
            self._expected = 0
            self._acknowledge(UNSUPPORTED, reply)
            return False
        item = item_from(message)
        bad = _not_a_number(item)
        if bad is not None:
            self._expected = 0
            self._acknowledge(_INVALID_PARAMETER_1 + bad, reply)
            return False
        self._incoming.append(item)
        if len(self._incoming) < self._expected:
            self._request(len(self._incoming), reply)
            return False
        self.items, self._expected = self._incoming, 0
        self._acknowledge(ACCEPTED, reply)
        return True

    def _request(self, sequence: int, reply: Reply) -> None:
        reply.send(mavlink.MAVLink_mission_request_int_message(*self._peer, sequence))

    def _acknowledge(self, result: int, reply: Reply) -> None:
        reply.send(mavlink.MAVLink_mission_ack_message(*self._peer, result))

    def _give(self, sequence: int, reply: Reply) -> None:
        if not 0 <= sequence < len(self.items):
            self._acknowledge(INVALID_SEQUENCE, reply)
            return
        item = self.items[sequence]
        reply.send(
            mavlink.MAVLink_mission_item_int_message(
                *self._peer,
                sequence,
                item.frame,
                item.command,
                0,
                1,
                *item.parameters,
                round(item.latitude_deg * 1e7),
                round(item.longitude_deg * 1e7),
                item.altitude_m,
            )
        )


def _not_a_number(item: StoredMissionItem) -> int | None:
    """Index of the first NaN parameter that is not allowed; None if there is none. Only the yaw of
    an item with a position may be NaN, as in ArduPilot.
    """
    for index, value in enumerate(item.parameters):
        if isnan(value) and not (index == 3 and item.command in NAVIGATION):
            return index
    return None


def item_from(message: Any) -> StoredMissionItem:
    """Read MISSION_ITEM_INT, COMMAND_INT (1e-7 degrees) or MISSION_ITEM (degrees)."""
    scale = 1.0 if message.get_type() == "MISSION_ITEM" else 1e-7
    return StoredMissionItem(
        message.command,
        message.frame,
        (message.param1, message.param2, message.param3, message.param4),
        message.x * scale,
        message.y * scale,
        message.z,
    )
