"""The mission is read for those who show it, again when it may be another, and not otherwise."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, VehicleState
from mavlink_bridge.vehicle.mission import MissionWatch, MissionWaypoint

S = 1_000_000_000
US = (1, 191)
RELATIVE = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
ITEMS = [
    (16, 0, 473977420, 85455940),
    (22, RELATIVE, 0, 0),  # take-off here: no place
    (16, RELATIVE, 474000000, 85455940),
    (183, RELATIVE, 9, 1500),  # a servo
    (19, RELATIVE, 474000000, 85500000),
    (16, RELATIVE, 2_000_000_000, 0),  # beyond the pole
]
PLACES = [0, 2, 4]


class Conversation:
    """A watch with a link to an autopilot that answers at once, on a simulated clock."""

    def __init__(self, items: list[tuple[int, int, int, int]]) -> None:
        self.items = items
        self.lost = 0
        self.asked: list[str] = []
        self.now_ns = S
        self.state = VehicleState(connected=True)
        self.watch = MissionWatch(US[1])
        self.watch.wanted = True
        self.link = SimpleNamespace(system_id=1, send=self._hear)
        self._answers: list[Any] = []

    def _hear(self, message: Any, component: int) -> None:
        assert component == US[1]
        kind = message.get_type()
        self.asked.append(kind)
        if self.lost > 0:
            self.lost -= 1
        elif kind == "MISSION_REQUEST_LIST":
            count = mavlink.MAVLink_mission_count_message(*US, len(self.items), 0)
            self._answers.append(count)
        elif kind == "MISSION_REQUEST_INT":
            self._answers.append(item(message.seq, *self.items[message.seq]))

    def run(self, seconds: float) -> list[str]:
        """Goes on; what was asked in that time."""
        self.asked.clear()
        end_ns = self.now_ns + int(seconds * S)
        while self.now_ns < end_ns:
            self.watch.tick(self.link, self.state, self.now_ns)
            while self._answers:
                self.watch.on_message(self.link, self._answers.pop(0), self.now_ns)
            self.now_ns += S // 10
        return list(self.asked)

    @property
    def numbers(self) -> list[int]:
        return [w.number for w in self.watch.waypoints]


def item(seq: int, command: int, frame: int, x: int, y: int, to: tuple[int, int] = US) -> Any:
    return mavlink.MAVLink_mission_item_int_message(
        *to, seq, frame, command, 0, 1, 0, 0, 0, 0, x, y, 30.0, 0
    )


def test_it_is_read_once_and_its_number_asked_for_now_and_then() -> None:
    talk = Conversation(ITEMS)
    asked = talk.run(1.0)
    assert asked.count("MISSION_REQUEST_INT") == len(ITEMS)
    assert asked[-1] == "MISSION_ACK"
    assert talk.numbers == PLACES
    assert talk.watch.waypoints[1] == MissionWaypoint(
        2, pytest.approx(47.4), pytest.approx(8.545594)
    )
    assert talk.run(60.0) == ["MISSION_REQUEST_LIST"] * 6


@pytest.mark.parametrize("change", ["shorter", "armed", "mode", "reboot"])
def test_it_is_read_again_when_it_may_be_another(change: str) -> None:
    talk = Conversation(ITEMS)
    talk.run(1.0)
    talk.items = [ITEMS[0], ITEMS[4]] if change == "shorter" else ITEMS[4::-1]
    if change == "armed":
        talk.state = replace(talk.state, armed=True)
    elif change == "mode":
        talk.state = replace(talk.state, custom_mode=3)
    elif change == "reboot":
        talk.watch.reset()
    talk.run(12.0)
    expected = [0, 1] if change == "shorter" else [0, 2, 4]
    assert talk.numbers == expected
    assert talk.watch.waypoints[0].longitude_deg == pytest.approx(
        ITEMS[0 if change == "shorter" else 4][3] * 1e-7
    )


def test_lost_answers_are_asked_for_again_and_silence_ends_it() -> None:
    talk = Conversation(ITEMS)
    talk.lost = 1
    talk.run(12.0)
    assert talk.numbers == PLACES
    talk.items = ITEMS[:3]
    talk.run(9.0)
    talk.items, talk.lost = ITEMS[:4], 0
    talk.watch.reset()
    talk.run(0.1)  # the count is known
    talk.lost = 10**6
    asked = talk.run(60.0)
    assert asked.count("MISSION_REQUEST_INT") <= 5
    assert asked.count("MISSION_REQUEST_LIST") <= 6


def test_another_stations_conversation_and_other_lists_are_not_taken() -> None:
    talk = Conversation(ITEMS)
    talk.run(1.0)
    place = (16, RELATIVE, 10, 10)
    for message in (
        mavlink.MAVLink_mission_count_message(255, 190, 1, 0),
        mavlink.MAVLink_mission_count_message(*US, 1, mavlink.MAV_MISSION_TYPE_FENCE),
        item(0, *place, to=(255, 190)),
        item(0, *place),  # asked for by nobody
    ):
        talk.watch.on_message(talk.link, message, talk.now_ns)
    assert talk.numbers == PLACES


def test_the_bridge_reads_it_on_its_own_link(autopilot: Any) -> None:
    answer = autopilot.answer

    def mission(m: Any) -> None:
        kind = m.get_type()
        if kind == "MISSION_REQUEST_LIST":
            autopilot.send(mavlink.MAVLink_mission_count_message(1, 191, len(ITEMS), 0))
        elif kind == "MISSION_REQUEST_INT":
            autopilot.send(item(m.seq, *ITEMS[m.seq]))
        else:
            answer(m)

    autopilot.answer = mission
    with Bridge(BridgeConfig(connection=f"udpout:127.0.0.1:{autopilot.port}"), 48.0) as bridge:
        autopilot.wait_for("TIMESYNC")
        assert not autopilot.of("MISSION_REQUEST_LIST")
        assert bridge.mission() == ()
        autopilot.wait_for("MISSION_ACK")
        assert [w.number for w in bridge.mission()] == PLACES
