"""The mission that the flight controller holds, for checks before a flight.

https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

import time
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.errors import MissionError
from mavlink_bridge.preflight.client import VehicleClient
from mavlink_bridge.vehicle.mission import MissionWaypoint, place_of

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
        """The places of the mission in order; MissionError when it is not handed over."""
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
        items = [self._items[number] for number in range(count)]
        return [place for item in items if (place := place_of(item)) is not None]

    def _repeat(self, question: Any, answered: Any, what: str) -> None:
        for _ in range(_RETRIES):
            self.ask(question)
            if self.wait_for(lambda: answered() or self._refusal is not None, _ANSWER_S):
                break
        if not answered():
            why = "silence" if self._refusal is None else f"MAV_MISSION_RESULT {self._refusal}"
            raise MissionError(f"the flight controller did not give {what} of its mission ({why})")

    def take(self, message: Any) -> None:
        """MISSION_COUNT, MISSION_ITEM_INT or a refusal; other mission types are not ours."""
        if getattr(message, "mission_type", 0) != mavlink.MAV_MISSION_TYPE_MISSION:
            return
        kind = message.get_type()
        if kind == "MISSION_COUNT":
            self._count = message.count
        elif kind == "MISSION_ITEM_INT":
            self._items[message.seq] = message
        elif message.type != mavlink.MAV_MISSION_ACCEPTED:
            self._refusal = message.type


def download_mission(config: BridgeConfig) -> list[MissionWaypoint]:
    """The places of the mission that the flight controller at `config.connection` holds."""
    with MissionDownloader(config) as client:
        return client.download()
