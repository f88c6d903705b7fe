"""The mission is downloaded from a small autopilot, the embedded vehicle and the real one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import BridgeConfig
from mavlink_bridge.errors import ConnectionSilentError, MissionError
from mavlink_bridge.preflight.client import download_mission
from mavlink_bridge.vehicle.mission import MissionWaypoint
from sitl.geodesy import Location
from sitl.ground.mission_client import MissionStep, takeoff_step, waypoint_step
from sitl.ground.pilot import Pilot
from sitl.vehicles.launch import ArduPilotSitl, EmbeddedSitl

HOME = Location(47.397742, 8.545594, 488.0)
RELATIVE = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
# (command, frame, x, y): home, take-off here, a place, a servo, a place in local metres, a place
ITEMS = [
    (16, 0, 473977420, 85455940),
    (22, RELATIVE, 0, 0),
    (16, RELATIVE, 474000000, 85455940),
    (183, RELATIVE, 9, 1500),
    (16, mavlink.MAV_FRAME_LOCAL_NED, 1000, 1000),
    (19, RELATIVE, 474000000, 85500000),
]
NOT_ON_EARTH = [*ITEMS[:2], (16, RELATIVE, 1_740_000_000, 85455940)]
MISSION = "mavlink_bridge.preflight.client"


def config(connection: str) -> BridgeConfig:
    return BridgeConfig(connection=connection)


@pytest.fixture
def with_mission(autopilot: Any) -> Callable[..., Any]:
    """The small autopilot, with a mission; `lost` answers are not sent, `refused` is an ack."""

    def make(lost: int = 0, refused: int | None = None, silent: bool = False) -> Any:
        left = [lost]
        answer = autopilot.answer

        def reply(message: Any) -> None:
            if left[0] > 0:
                left[0] -= 1
            elif refused is not None:
                autopilot.send(mavlink.MAVLink_mission_ack_message(255, 0, refused))
            else:
                autopilot.send(message)

        def mission(m: Any) -> None:
            kind = m.get_type()
            if kind == "MISSION_REQUEST_LIST" and not silent:
                # A fence of one item is not the mission.
                autopilot.send(mavlink.MAVLink_mission_count_message(1, 191, 1, 1))
                reply(mavlink.MAVLink_mission_count_message(1, 191, len(ITEMS), 0))
            elif kind == "MISSION_REQUEST_INT":
                command, frame, x, y = ITEMS[m.seq]
                reply(
                    mavlink.MAVLink_mission_item_int_message(
                        1, 191, m.seq, frame, command, 0, 1, 0, 0, 0, 0, x, y, 30.0, 0
                    )
                )
            else:
                answer(m)

        autopilot.answer = mission
        return autopilot

    return make


PLACES = [
    MissionWaypoint(0, 47.397742, 8.545594),
    MissionWaypoint(2, 47.4, 8.545594),
    MissionWaypoint(5, 47.4, 8.55),
]


def same(found: list[MissionWaypoint], expected: list[MissionWaypoint]) -> None:
    assert [w.number for w in found] == [w.number for w in expected]
    for a, b in zip(found, expected, strict=True):
        assert (a.latitude_deg, a.longitude_deg) == pytest.approx(
            (b.latitude_deg, b.longitude_deg), abs=2e-7
        )


def test_places_of_the_mission(with_mission: Callable[..., Any], monkeypatch) -> None:
    """Two answers are lost; a count that a station asks for meanwhile is not ours; a place that is
    not set is where the vehicle is.
    """
    unset = (21, RELATIVE, 0x7FFFFFFF, 0x7FFFFFFF)  # land here
    monkeypatch.setattr(f"{__name__}.ITEMS", [*ITEMS, unset])
    vehicle = with_mission(lost=2)
    answer = vehicle.answer

    def interrupted(message: Any) -> None:
        if message.get_type() == "MISSION_REQUEST_INT":
            vehicle.send(mavlink.MAVLink_mission_count_message(1, 191, 50, 0))
        answer(message)

    vehicle.answer = interrupted
    same(download_mission(config(f"udpout:127.0.0.1:{vehicle.port}")), PLACES)
    acks = vehicle.wait_for("MISSION_ACK")
    assert acks[0].type == mavlink.MAV_MISSION_ACCEPTED


@pytest.mark.parametrize(
    ("how", "changed", "why"),
    [
        ({"refused": mavlink.MAV_MISSION_DENIED}, {}, "number of items .*MAV_MISSION_RESULT 14"),
        ({"silent": True}, {f"{MISSION}._ITEM_ANSWER_S": 0.1}, "number of items .*sil"),
        ({}, {f"{MISSION}._LONGEST_S": -1.0}, "gave 0 of 6 items"),
        ({}, {f"{__name__}.ITEMS": NOT_ON_EARTH}, r"item 2 .* 174, 8\.54559 degrees"),
    ],
)
def test_why_there_is_no_mission_is_named(with_mission, monkeypatch, how, changed, why):
    for name, value in changed.items():
        monkeypatch.setattr(name, value)
    vehicle = with_mission(**how)
    with pytest.raises(MissionError, match=why):
        download_mission(config(f"udpout:127.0.0.1:{vehicle.port}"))


def test_nobody_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mavlink_bridge.preflight.client._CONNECT_S", 0.2)
    with pytest.raises(ConnectionSilentError, match="no autopilot heartbeat at udpout"):
        download_mission(config("udpout:127.0.0.1:9"))


def upload_and_download(vehicle: Any) -> None:
    places = [HOME.offset(north, east, 0.0) for north, east in ((200, 0), (200, 150), (-900, 0))]
    steps: list[MissionStep] = [
        takeoff_step(40.0),
        *(waypoint_step(p.latitude_deg, p.longitude_deg, 40.0) for p in places),
    ]
    assert not [w for w in download_mission(config(vehicle.companion_endpoint)) if w.number > 0]
    pilot = Pilot(vehicle.gcs_endpoint, alive=vehicle.check)
    pilot.link.connect()
    pilot.missions.upload(steps)
    found = download_mission(config(vehicle.companion_endpoint))
    pilot.link.close()
    flown = [w for w in found if w.number > 0]
    same(
        flown,
        [MissionWaypoint(2 + i, p.latitude_deg, p.longitude_deg) for i, p in enumerate(places)],
    )


def test_embedded_vehicle() -> None:
    with EmbeddedSitl(HOME) as vehicle:
        upload_and_download(vehicle)


@pytest.mark.sitl
def test_real_arducopter() -> None:
    with ArduPilotSitl(HOME) as vehicle:
        upload_and_download(vehicle)
