"""Reads the mission from the flight controller, for display.

https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.errors import MissionError
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.mission.items import FLOWN_TO, FRAMES, WITH_PLACE, MissionItem

MISSION_IN = ("MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ACK")
_POLE = 900_000_000  # 1e-7 degrees
# INT32_MAX stands for "not set" in a whole number, as NaN does in a float (MAVLink, commands).
_HERE = ((0, 0), (0x7FFFFFFF, 0x7FFFFFFF))
_MOST = 2000  # items; beyond that it is not read in flight
_COUNT_EVERY_NS = 10_000_000_000
_ANSWER_NS = 1_000_000_000
_TRIES = 5


@dataclass(frozen=True)
class MissionWaypoint:
    """A position of the mission. number: of the mission item; 0 is home in ArduPilot."""

    number: int
    latitude_deg: float
    longitude_deg: float


def waypoint_of(item: Any) -> MissionWaypoint | None:
    """Position of a MISSION_ITEM_INT; None for an item without one, or if it means the present
    position. `MissionError` for impossible coordinates.
    """
    flown = item.seq == 0 or item.command in FLOWN_TO
    if not flown or item.frame not in FRAMES or (item.x, item.y) in _HERE:
        return None
    if abs(item.x) > _POLE or abs(item.y) > 2 * _POLE:
        raise MissionError(
            f"item {item.seq} of the mission lies at {item.x * 1e-7:g}, {item.y * 1e-7:g} degrees, "
            "which is no place on Earth; load the mission into the vehicle again"
        )
    return MissionWaypoint(item.seq, item.x * 1e-7, item.y * 1e-7)


def mission_item(message: Any) -> MissionItem:
    """Convert a MISSION_ITEM_INT: degrees instead of 1e-7 degrees, 0 for the present position."""
    x, y = float(message.x), float(message.y)
    if (message.x, message.y) in _HERE:
        x = y = 0.0
    elif message.command in WITH_PLACE:
        x, y = x * 1e-7, y * 1e-7
    parameters = (message.param1, message.param2, message.param3, message.param4, x, y, message.z)
    return MissionItem(message.seq, message.command, message.frame, parameters)


class MissionWatch:
    """Downloads the mission when it is first needed, and again when it may have changed.

    ArduPilot does not report changes of the mission. So the number of items is requested every ten
    seconds. The whole mission is read again when this number, the mode or the armed state changes.
    One request is under way at a time. Runs in the link's thread; any thread may set `wanted` (a
    display needs the mission) and read `waypoints`.
    """

    def __init__(self, component: int) -> None:
        self._component = component
        self.wanted = False
        self.waypoints: tuple[MissionWaypoint, ...] = ()
        self._known: int | None = None  # items
        self._flown_as: tuple[bool, int] | None = None
        self._reading: int | None = None  # items
        self._places: list[MissionWaypoint] = []
        self._item: int | None = None  # asked for; None: the number of items is
        self._tries = 0
        self._due_ns = 0

    def reset(self) -> None:
        """Read the mission again after a reboot or for another vehicle; `waypoints` stay till
        then.
        """
        self._known = self._reading = self._item = None
        self._due_ns = self._tries = 0

    def tick(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """Send the request that is due at this tick, if any; none until `wanted` is set."""
        if not self.wanted:
            return
        flown_as = (state.armed, state.custom_mode)
        if flown_as != self._flown_as:
            self._flown_as, self._known = flown_as, None
            if self._reading is None:
                self._due_ns = 0
        if now_ns < self._due_ns:
            return
        if self._reading is not None and self._tries >= _TRIES:
            self._reading = self._item = None
            self._tries = 0
            self._due_ns = now_ns + _COUNT_EVERY_NS
            return
        self._ask(link, now_ns)

    def on_message(self, link: Link, message: Any, now_ns: int) -> None:
        """Process MISSION_COUNT, MISSION_ITEM_INT or MISSION_ACK of the vehicle."""
        to = (message.target_system, message.target_component)
        if not self.wanted or to != (link.system_id, self._component):
            return  # another station's conversation
        if getattr(message, "mission_type", 0) != mavlink.MAV_MISSION_TYPE_MISSION:
            return
        kind = message.get_type()
        if kind == "MISSION_COUNT" and self._item is None:
            self._on_count(link, message, now_ns)
        elif kind == "MISSION_ITEM_INT" and message.seq == self._item and self._reading is not None:
            self._add_item(link, message, now_ns)
        elif kind == "MISSION_ACK":  # refused: a station is loading another one just now
            self._reading = self._item = None
            self._due_ns = now_ns + _COUNT_EVERY_NS

    def _on_count(self, link: Link, message: Any, now_ns: int) -> None:
        found = int(message.count)
        if found == self._known or found > _MOST:
            self._due_ns = now_ns + _COUNT_EVERY_NS
            return
        self._reading, self._places, self._tries = found, [], 0
        self._item = 0
        if found == 0:
            self._finish(link, now_ns)
        else:
            self._ask(link, now_ns)

    def _add_item(self, link: Link, message: Any, now_ns: int) -> None:
        assert self._reading is not None
        try:
            place = waypoint_of(message)
        except MissionError:  # the doctor names it
            place = None
        if place is not None:
            self._places.append(place)
        self._tries = 0
        self._item = message.seq + 1
        if self._item >= self._reading:
            self._finish(link, now_ns)
        else:
            self._ask(link, now_ns)

    def _finish(self, link: Link, now_ns: int) -> None:
        self.waypoints, self._known = tuple(self._places), self._reading
        self._reading = self._item = None
        self._due_ns = now_ns + _COUNT_EVERY_NS
        done = mavlink.MAVLink_mission_ack_message(
            link.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, mavlink.MAV_MISSION_ACCEPTED
        )
        link.send(done, self._component)

    def _ask(self, link: Link, now_ns: int) -> None:
        to = (link.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1)
        if self._reading is None or self._item is None:
            link.send(mavlink.MAVLink_mission_request_list_message(*to, 0), self._component)
            self._due_ns = now_ns + _COUNT_EVERY_NS
            return
        self._tries += 1
        link.send(mavlink.MAVLink_mission_request_int_message(*to, self._item, 0), self._component)
        self._due_ns = now_ns + _ANSWER_NS
