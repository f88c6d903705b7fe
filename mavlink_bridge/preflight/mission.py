"""Downloads the mission from the flight controller, for checks before a flight.

https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.errors import MissionError
from mavlink_bridge.mission.items import FRAMES
from mavlink_bridge.mission.path import planned_path
from mavlink_bridge.preflight.client import VehicleClient
from mavlink_bridge.vehicle.mission import MissionWaypoint, mission_item, waypoint_of

_RETRIES = 5
_ANSWER_S = 1.0
_LONGEST_S = 120.0  # for all items
_WANTED = (
    mavlink.MAVLINK_MSG_ID_MISSION_COUNT,
    mavlink.MAVLINK_MSG_ID_MISSION_ITEM_INT,
    mavlink.MAVLINK_MSG_ID_MISSION_ACK,
)


class MissionDownloader(VehicleClient):
    """Downloads the mission. A context manager."""

    def __init__(self, config: BridgeConfig) -> None:
        super().__init__(config, "mission", _WANTED)
        self._count: int | None = None
        self._items: dict[int, Any] = {}
        self._refusal: int | None = None

    def download(self) -> list[MissionWaypoint]:
        """Download home and the mission's positions in flight order; otherwise `MissionError`."""
        self._count, self._refusal = None, None
        self._items.clear()
        self._repeat(
            mavlink.MAVLink_mission_request_list_message(self.system, self.component, 0),
            lambda: self._count is not None,
            "the number of items",
        )
        # Once: a count that a ground station asks for meanwhile must not change ours.
        count, ends_s = self._count or 0, time.monotonic() + _LONGEST_S
        for number in range(count):
            if time.monotonic() > ends_s:
                raise MissionError(
                    f"the flight controller gave {number} of {count} items of its mission in "
                    f"{_LONGEST_S:.0f} s; check the link's rate, or the mission in the vehicle"
                )
            self._repeat(
                mavlink.MAVLink_mission_request_int_message(self.system, self.component, number, 0),
                lambda number=number: number in self._items,
                f"item {number}",
            )
        self.ask(mavlink.MAVLink_mission_ack_message(self.system, self.component, 0))
        return _as_flown([self._items[number] for number in range(count)])

    def _repeat(self, question: Any, answered: Any, what: str) -> None:
        for _ in range(_RETRIES):
            self.ask(question)
            if self.wait_for(lambda: answered() or self._refusal is not None, _ANSWER_S):
                break
        if not answered():
            why = "silence" if self._refusal is None else f"MAV_MISSION_RESULT {self._refusal}"
            raise MissionError(f"the flight controller did not give {what} of its mission ({why})")

    def take(self, message: Any) -> None:
        """Process MISSION_COUNT, MISSION_ITEM_INT or a refusal; other mission types are ignored."""
        if getattr(message, "mission_type", 0) != mavlink.MAV_MISSION_TYPE_MISSION:
            return
        kind = message.get_type()
        if kind == "MISSION_COUNT":
            self._count = message.count
        elif kind == "MISSION_ITEM_INT":
            self._items[message.seq] = message
        elif message.type != mavlink.MAV_MISSION_ACCEPTED:
            self._refusal = message.type


def _as_flown(messages: Sequence[Any]) -> list[MissionWaypoint]:
    """Positions in flight order; the first message is home. Local frames are left out."""
    home = waypoint_of(messages[0]) if messages else None
    items = [mission_item(m) for m in messages[1:] if not _is_local(m)]
    place = None if home is None else (home.latitude_deg, home.longitude_deg)
    flown = planned_path(items, place).path
    places = [MissionWaypoint(p.item, p.latitude_deg, p.longitude_deg) for p in flown if p.item > 0]
    return places if home is None else [home, *places]


def _is_local(message: Any) -> bool:
    return message.command <= mavlink.MAV_CMD_NAV_LAST and message.frame not in FRAMES


def download_mission(config: BridgeConfig) -> list[MissionWaypoint]:
    """Download home (if it is known, first) and the mission's positions in flight order from the
    flight controller at `config.connection`. `ConnectionSilentError` or `MissionError` if it fails.
    """
    with MissionDownloader(config) as client:
        return client.download()
