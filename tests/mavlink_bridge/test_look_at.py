"""Look-at: who may turn the gimbal, what the autopilot is told, and what the operator hears."""

import math
import time
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, TargetReport
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import CommandAnswer, LookAtRefusal
from mavlink_bridge.camera.look_at import LOOK_AHEAD, LOOK_AT_PLACE, LOOK_AT_TARGET, LookAt
from mavlink_bridge.config import CameraConfig
from mavlink_bridge.link.link import sleep_until
from sitl.geodesy import Location
from sitl.vehicles.launch import GIMBAL, ArduPilotSitl, EmbeddedSitl

SECOND = 10**9
OK, DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
HOME = Location(47.397742, 8.545594, 488.0)


class Station:
    """A `LookAt` with what it said."""

    def __init__(self, **options):
        self.said: list[Any] = []
        config = BridgeConfig(**({"look_at": True} | options))
        self.look = LookAt(config, 47.0, self.said.append)

    def command(self, number, *parameters):
        padded = [*parameters, *([0.0] * (7 - len(parameters)))]
        return self.look.command(mavlink.MAVLink_command_long_message(1, 100, number, 0, *padded))

    def place(self, latitude=47.4, longitude=8.55, frame=0):
        x, y = round(latitude * 1e7), round(longitude * 1e7)
        message = mavlink.MAVLink_command_int_message(
            1, 100, frame, LOOK_AT_PLACE, 0, 0, 0, 0, 0, 0, x, y, 500.0
        )
        return self.look.command(message)


def _target(number, latitude=47.4, time_ns=0):
    return TargetReport(time_ns, latitude, 8.55, 547.0, target_id=number)


def test_nobody_turns_the_gimbal_where_the_deployment_does_not_allow_it():
    for options, why in (
        ({"look_at": False}, "bridge.look_at is off"),
        ({"camera": CameraConfig(mount="fixed")}, "the camera is fixed"),
    ):
        station = Station(**options)
        station.look.report(_target(3))
        results = [station.place(), station.command(LOOK_AT_TARGET, 3.0)]
        assert results == [DENIED, DENIED]
        assert station.look.due(SECOND) is None
        assert station.said == [alert(AlertId.LOOK_AT_REFUSED, why=why)] * 2


def test_a_place_is_sent_once_and_a_wrong_one_is_refused_with_a_word():
    station = Station()
    assert station.place() == OK
    assert station.look.due(SECOND) == (LOOK_AT_PLACE, 0, 474000000, 85500000, 500.0)
    station.look.answered(OK)
    assert [station.look.due(SECOND * k) for k in range(2, 20)] == [None] * 18
    nan = math.nan
    wrong = [station.command(LOOK_AT_PLACE, 0, 0, 0, 0, nan, 8.0, 1.0), station.place(0.0, 0.0)]
    assert [*wrong, station.place(95.0), station.place(frame=8)] == [DENIED] * 4
    assert station.said == [alert(AlertId.LOOK_AT_REFUSED, why=LookAtRefusal.NO_PLACE)] * 4
    assert station.command(LOOK_AHEAD) == OK
    ahead = station.look.due(30 * SECOND)
    assert ahead is not None
    assert ahead[0] == LOOK_AHEAD


def test_a_target_is_followed_by_its_number_until_it_ends():
    station = Station()
    assert station.command(LOOK_AT_TARGET, 3.0) == DENIED  # nobody knows it
    station.look.report(_target(3))
    station.look.report(_target(4, 47.5))
    assert station.command(LOOK_AT_TARGET, 3.0) == OK
    sent = []
    for k in range(50):  # 5 s: it drives 2 m/s to the north
        station.look.report(_target(3, 47.4 + 0.2 * k / 111_320))
        station.look.report(_target(4, 47.5))
        due = station.look.due(SECOND + k * SECOND // 10)
        if due is not None:
            station.look.answered(OK)
            sent.append((k, due[2], due[4]))
    assert [k for k, _, _ in sent] == [0, 10, 20, 30, 40]
    assert sent[0][1:] == (474000000, 500.0)
    assert (sent[-1][1] - sent[0][1]) * 1e-7 * 111_320 == pytest.approx(8.0, abs=0.1)
    station.look.forget(4)
    station.look.forget(3)
    station.look.report(_target(3, 47.9))  # of the same number again: it is not ours any more
    assert station.look.due(60 * SECOND) is None
    assert station.said[1:] == [alert(AlertId.LOOK_AT_ENDED, number=3)]


def test_an_autopilot_that_refuses_or_does_not_answer_is_told():
    station = Station()
    station.place()
    assert station.look.due(SECOND) is not None
    station.look.answered(mavlink.MAV_RESULT_UNSUPPORTED)
    assert station.look.due(9 * SECOND) is None
    station.place(47.41)
    assert station.look.due(10 * SECOND) is not None
    assert station.look.due(14 * SECOND) is None
    assert station.said == [
        alert(AlertId.LOOK_AT_DENIED, result=CommandAnswer.UNSUPPORTED),
        alert(AlertId.LOOK_AT_UNANSWERED),
    ]


def test_a_stations_command_reaches_the_autopilot_through_the_bridge(autopilot):
    config = BridgeConfig(connection="udpin:127.0.0.1:0", look_at=True)
    with Bridge(config, 47.0) as bridge:
        assert sleep_until(lambda: bridge.port is not None, 30.0)
        autopilot.peer = ("127.0.0.1", bridge.port)
        assert sleep_until(lambda: bridge.state().connected, 30.0)
        bridge.report(_target(7, time_ns=time.monotonic_ns()))
        for system, number in ((254, 7.0), (255, 9.0), (255, 7.0)):
            command = mavlink.MAVLink_command_long_message(
                1, 100, LOOK_AT_TARGET, 0, number, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            )
            autopilot.send(command, 190, system)
        (told,) = autopilot.wait_for("COMMAND_INT")
        assert (told.command, told.target_component, told.frame) == (LOOK_AT_PLACE, 1, 0)
        assert (told.x, told.y, told.z) == (474000000, 85500000, 500.0)
        answers = [m.result for m in autopilot.of("COMMAND_ACK") if m.command == LOOK_AT_TARGET]
        assert answers == [DENIED, DENIED, OK]  # not in ground_systems; nobody knows it
        refused = mavlink.MAVLink_command_ack_message(
            LOOK_AT_PLACE, mavlink.MAV_RESULT_FAILED, 0, 0, 1, 191
        )
        autopilot.send(refused)
        news = alert(AlertId.LOOK_AT_DENIED, result=CommandAnswer.FAILED)
        assert sleep_until(lambda: news in bridge.alerts(), 30.0)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(EmbeddedSitl, marks=pytest.mark.long),
        pytest.param(ArduPilotSitl, marks=pytest.mark.sitl),
    ],
)
def test_the_gimbal_turns_to_a_target_through_the_autopilot_and_stays_there(kind):
    """The whole way: station, routing, camera component, autopilot, mount.

    From the ground at home, a target 100 m to the west at the same height: 270 degrees, level.
    """
    with kind(HOME, parameters=GIMBAL) as vehicle:
        config = BridgeConfig(connection=vehicle.companion_endpoint, look_at=True)
        station = mavutil.mavlink_connection(vehicle.spare_endpoint, source_system=255)
        west = 8.545594 - 100.0 / (111_320 * math.cos(math.radians(HOME.latitude_deg)))
        with Bridge(config, 47.0) as bridge:

            def asked():
                station.mav.heartbeat_send(6, 8, 0, 0, 0)
                now_ns = time.monotonic_ns()
                bridge.report(TargetReport(now_ns, 47.397742, west, 535.0, target_id=7))
                station.mav.command_long_send(1, 100, LOOK_AT_TARGET, 0, 7, 0, 0, 0, 0, 0, 0)
                ack = station.recv_match(type="COMMAND_ACK", blocking=True, timeout=1.0)
                return ack is not None and ack.command == LOOK_AT_TARGET and ack.result == OK

            def looks_west():
                gimbal = bridge.gimbal_at(time.monotonic_ns() - 200_000_000)
                if gimbal is None:
                    return False
                off = (math.degrees(gimbal.yaw_rad) - 270.0 + 180.0) % 360.0 - 180.0
                return abs(off) < 3.0 and abs(math.degrees(gimbal.pitch_rad)) < 3.0

            assert sleep_until(lambda: bridge.state().connected, 30.0)
            assert not looks_west()
            # It refuses until it knows where it is; the operator asks again.
            assert sleep_until(lambda: asked() and looks_west(), 120.0, step_s=0.5), bridge.alerts()
        station.close()
