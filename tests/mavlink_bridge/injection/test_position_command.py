"""MAV_CMD_EXTERNAL_POSITION_ESTIMATE as the injection: sent to a vehicle that fuses it only."""

from __future__ import annotations

import math
import time
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, VisionFix
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import CommandAnswer
from mavlink_bridge.config import InjectionConfig
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.preflight.rules import ardupilot_rules, find_source_set, missing_feature
from mavlink_bridge.vehicle.profile import select_profile
from sitl.geodesy import Location
from sitl.vehicles.launch import ArduPilotSitl
from tests.mavlink_bridge.simulated import GEOID, HOME, METRE, MS, SECOND, Flight

COMMAND = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
ACCEPTED, FAILED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED
INJECTION = InjectionConfig(message="external_position_estimate", rate_hz=10, delay_ms=100)
PASSED_S = 16.0  # the shadow check


class Vehicle(Flight):
    """Answers the command with `result`, or, None, not at all."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, result: int | None) -> None:
        super().__init__(monkeypatch, injection=INJECTION)
        self.result = result
        self.gnss_north_m = 0.0
        self.flags = 831

    def _vehicle(self, step: int) -> None:
        super()._vehicle(step)
        if step % 100 == 50:
            self.say(mavlink.MAVLink_ekf_status_report_message(self.flags, 0.1, 0.1, 0.1, 0.1, 0.0))

    def _answer(self, m: Any) -> None:
        if getattr(m, "command", 0) == COMMAND and self.result is not None:
            self.say(mavlink.MAVLink_command_ack_message(COMMAND, self.result, 0, 0, 1, 197))
        super()._answer(m)

    def commands(self, since_ns: int = 0) -> list[tuple[int, Any]]:
        sent = self.link.sent
        return [(t, m) for t, m, _ in sent if getattr(m, "command", 0) == COMMAND and t > since_ns]

    def lose_gnss(self) -> int:
        self.gnss_north_m = None
        return self.now_ns


def test_a_vehicle_that_accepts_it_beside_gnss_gets_every_fix_once_and_after_gnss_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vehicle = Vehicle(monkeypatch, ACCEPTED)
    vehicle.north_m = 1.0
    vehicle.run(PASSED_S)
    lost_ns = vehicle.lose_gnss()
    vehicle.run(10.0)
    sent = vehicle.commands(lost_ns)
    assert 95 <= len(sent) <= 101  # 10 Hz
    exposures = [t * 1e-9 - m.param2 for t, m in sent]
    assert all(0.09 < b - a < 0.11 for a, b in pairwise(exposures))
    _, last = sent[-1]
    assert last.get_type() == "COMMAND_INT"
    assert (last.target_system, last.target_component) == (1, 1)
    assert last.frame == mavlink.MAV_FRAME_GLOBAL
    assert math.isnan(last.z)  # ArduPilot denies a height
    assert last.x == round((HOME[0] + METRE) * 1e7)
    assert last.param3 == pytest.approx(0.2236, abs=0.005)  # with the least sigma
    assert 0.1 <= last.param2 < 0.12  # its age
    passed_s = (sent[-1][0] - sent[0][0]) * 1e-9
    assert last.param1 - sent[0][1].param1 == pytest.approx(passed_s, abs=0.002)
    assert vehicle.told(AlertId.COMMAND_NOT_TAKEN) == []
    assert not [m for _, m, _ in vehicle.link.sent if m.get_type() == "VISION_POSITION_ESTIMATE"]


@pytest.mark.parametrize("result", [FAILED, mavlink.MAV_RESULT_UNSUPPORTED])
def test_a_vehicle_that_refuses_it_beside_gnss_is_sent_none_though_it_takes_a_reset_later(
    monkeypatch: pytest.MonkeyPatch, result: int
) -> None:
    vehicle = Vehicle(monkeypatch, result)
    vehicle.run(PASSED_S)
    assert len(vehicle.commands()) == 1  # the question
    answer = CommandAnswer.FAILED if result == FAILED else CommandAnswer.UNSUPPORTED
    refused = alert(AlertId.COMMAND_NOT_TAKEN, answer=answer)
    assert vehicle.told(AlertId.COMMAND_NOT_TAKEN, AlertId.INJECTING)[-1] == refused
    assert vehicle.end.injection_fault == refused
    vehicle.lose_gnss()
    vehicle.result = ACCEPTED  # as ArduPilot 4.7 from 1 s after the last GNSS position
    vehicle.run(30.0)
    assert len(vehicle.commands()) == 1
    assert vehicle.told(AlertId.INJECTING) == []
    vehicle.reboot()
    vehicle.gnss_north_m = 0.0
    vehicle.run(20.0)
    assert len(vehicle.commands()) > 50  # another firmware, perhaps: it is asked again


@pytest.mark.parametrize(
    ("gnss_north_m", "flags"),
    [(0.0, 831), (None, 831), (0.0, 831 | mavlink.EKF_GPS_GLITCHING), (0.0, 167)],
)
def test_a_vehicle_that_does_not_answer_is_asked_once_a_second_and_only_on_gnss(
    monkeypatch: pytest.MonkeyPatch, gnss_north_m: float | None, flags: int
) -> None:
    vehicle = Vehicle(monkeypatch, None)
    vehicle.gnss_north_m, vehicle.flags = gnss_north_m, flags
    gnss = gnss_north_m is not None and flags == 831  # that aids the EKF
    vehicle.run(PASSED_S + 10.0)
    times = [t for t, _ in vehicle.commands()]
    assert (15 <= len(times) <= 21) if gnss else times == []
    assert all(b - a >= SECOND - MS for a, b in pairwise(times))
    why = CommandAnswer.NOT_ANSWERED if gnss else CommandAnswer.NOT_ASKED
    silent = alert(AlertId.COMMAND_NOT_TAKEN, answer=why)
    assert vehicle.told(AlertId.COMMAND_NOT_TAKEN) == [silent]


def test_a_vehicle_that_stops_accepting_is_asked_until_it_accepts_again(monkeypatch):
    vehicle = Vehicle(monkeypatch, ACCEPTED)
    vehicle.run(PASSED_S)
    vehicle.result = FAILED
    vehicle.run(3.0)
    refused_ns = vehicle.now_ns
    vehicle.run(10.0)
    assert 9 <= len(vehicle.commands(refused_ns)) <= 11
    failed = alert(AlertId.COMMAND_NOT_TAKEN, answer=CommandAnswer.FAILED)
    assert vehicle.end.sender.refusal == failed
    vehicle.result, again_ns = ACCEPTED, vehicle.now_ns
    vehicle.run(10.0)
    assert len(vehicle.commands(again_ns)) > 80
    assert vehicle.told(AlertId.INJECTING, AlertId.COMMAND_NOT_TAKEN)[-1].id is AlertId.INJECTING


def test_an_answer_to_somebody_elses_command_is_not_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle = Vehicle(monkeypatch, None)
    vehicle.run(PASSED_S)
    before = len(vehicle.commands())
    ack = mavlink.MAVLink_command_ack_message(COMMAND, ACCEPTED, 0, 0, 255, 190)
    vehicle.say(ack)
    vehicle.run(5.0)
    assert len(vehicle.commands()) - before <= 5  # still asking


def test_it_has_no_source_set_and_is_for_ardupilot_only() -> None:
    config = BridgeConfig(injection=INJECTION)
    rules = ardupilot_rules(config, find_source_set(config, {"GPS1_TYPE": 1.0}.get))
    assert {rule.names[0] for rule in rules} == {"AHRS_EKF_TYPE", "EK3_ENABLE"}
    assert missing_feature(config, {"EK3_SRC1_POSXY": 3.0}.get, px4=False) is None
    assert INJECTION.message in select_profile("ardupilot", (4, 7, 0)).messages
    assert INJECTION.message not in select_profile("px4", (1, 16, 0)).messages


@pytest.mark.sitl
def test_ardupilot_of_today_refuses_it_beside_gnss_and_is_asked_once() -> None:
    injection = INJECTION.model_copy(update={"force": True})  # the shadow check is not the subject
    with ArduPilotSitl(Location(*HOME, 488.0)) as vehicle:
        config = BridgeConfig(
            connection=vehicle.companion_endpoint, mode="inject", injection=injection
        )
        with Bridge(config, GEOID) as bridge:

            def refused() -> bool:
                state = bridge.state()
                if state.latitude_deg and state.longitude_deg:
                    place = (state.latitude_deg, state.longitude_deg, 488.0 + GEOID)
                    exposed_ns, sigma = time.monotonic_ns() - 50 * MS, np.eye(3) * 0.25
                    bridge.submit(VisionFix(exposed_ns, *place, position_covariance_ned=sigma))
                told = [a for a in bridge.alerts() if a.id is AlertId.COMMAND_NOT_TAKEN]
                return alert(AlertId.COMMAND_NOT_TAKEN, answer=CommandAnswer.FAILED) in told

            assert sleep_until(refused, 120.0, step_s=0.1), bridge.alerts()
            assert bridge.counters()["bridge_position_commands"] == 1
            assert "bridge_injected" not in bridge.counters()
