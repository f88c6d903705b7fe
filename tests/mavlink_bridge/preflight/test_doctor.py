"""Parameter rules, and the examination of a small autopilot."""

from __future__ import annotations

import math
import socket
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig
from mavlink_bridge.config import InjectionConfig, OriginConfig, SourceSwitchConfig
from mavlink_bridge.errors import ParameterError
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.preflight.client import ParameterClient, decode_value, encode_value
from mavlink_bridge.preflight.doctor import check_parameters, examine, repair
from mavlink_bridge.preflight.failsafes import failsafes, px4_failsafes
from mavlink_bridge.preflight.rules import (
    DoctorFinding,
    ardupilot_rules,
    arming_rules,
    find_source_set,
    gnss_rules,
    missing_feature,
    px4_rules,
)

ORIGIN = OriginConfig(latitude_deg=47.0, longitude_deg=8.0, altitude_amsl_m=500.0)
GOOD = {
    "AHRS_EKF_TYPE": 3.0,
    "EK3_ENABLE": 1.0,
    "VISO_TYPE": 1.0,
    "EK3_SRC1_POSXY": 6.0,
    "EK3_SRC1_VELXY": 6.0,
    "EK3_VIS_VERR_MIN": 0.1,
    "EK3_VIS_VERR_MAX": 2.0,
    "EK3_SRC1_VELZ": 0.0,
    "EK3_SRC1_POSZ": 1.0,
    "EK3_SRC1_YAW": 1.0,
    "VISO_DELAY_MS": 100.0,
    "VISO_SCALE": 1.0,
    "VISO_POS_X": 0.0,
    "VISO_POS_Y": 0.0,
    "VISO_POS_Z": 0.0,
    "VISO_QUAL_MIN": 0.0,
    "GPS1_TYPE": 0.0,
    "FS_EKF_ACTION": 1.0,
    "FS_EKF_THRESH": 0.8,
    "FS_DR_ENABLE": 0.0,
    "FENCE_ENABLE": 1.0,
    "FENCE_TYPE": 5.0,
    "FENCE_ACTION": 2.0,
}


def config(port: int = 14551, **injection: Any) -> BridgeConfig:
    return BridgeConfig(
        connection=f"udpout:127.0.0.1:{port}", injection=InjectionConfig(**injection), origin=ORIGIN
    )


def failures(settings: BridgeConfig, parameters: dict[str, float]) -> set[str]:
    rules = ardupilot_rules(settings, find_source_set(settings, parameters.get))
    return {f.name for f in check_parameters(rules, parameters.get) if not f.ok}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("EK3_SRC1_VELXY", 3.0),
        ("EK3_SRC1_VELZ", 3.0),
        ("VISO_TYPE", 0.0),
        ("VISO_DELAY_MS", 10.0),
        ("VISO_QUAL_MIN", 50.0),
        ("EK3_SRC1_POSXY", 3.0),
        ("EK3_SRC1_YAW", 6.0),
        ("GPS1_TYPE", 1.0),
        ("AHRS_EKF_TYPE", 2.0),
    ],
)
def test_each_wrong_parameter_is_found(name: str, value: float) -> None:
    assert failures(config(), GOOD) == set()
    assert failures(config(), {**GOOD, name: value}) == {name}


def test_second_source_set_is_found_and_gps_is_left_alone_there() -> None:
    second = {k.replace("SRC1", "SRC2"): v for k, v in GOOD.items()}
    second |= {"EK3_SRC1_POSXY": 3.0, "GPS1_TYPE": 1.0}
    assert find_source_set(config(), second.get) == 2
    assert failures(config(), second) == set()


def test_a_vehicle_on_gnss_keeps_its_first_source_set() -> None:
    """Vision goes into the set it is switched to; the receiver is not taken away."""
    stock = {"EK3_SRC1_POSXY": 3.0, "EK3_SRC2_POSXY": 0.0, "GPS1_TYPE": 1.0}
    assert find_source_set(config(), stock.get) == 2
    rules = ardupilot_rules(config(), 2)
    names = {name for rule in rules for name in rule.names}
    assert "GPS1_TYPE" not in names
    assert "EK3_SRC1_POSXY" not in names


def test_gps_input_with_old_names_and_another_receiver() -> None:
    parameters = {
        "AHRS_EKF_TYPE": 3.0,
        "EK3_ENABLE": 1.0,
        "GPS_TYPE2": 1.0,
        "GPS_DELAY_MS2": 100.0,
        "VISO_TYPE": 1.0,
        "VISO_DELAY_MS": 100.0,
        "EK3_SRC1_POSXY": 3.0,
        "EK3_SRC1_VELXY": 3.0,
        "EK3_SRC1_VELZ": 3.0,
        "EK3_SRC1_POSZ": 1.0,
        "EK3_SRC1_YAW": 1.0,
    }
    settings = config(message="gps_input", gps_id=1)
    assert failures(settings, parameters) == {"GPS_TYPE2"}
    still = config(message="gps_input", gps_id=1, gps_velocity=False)
    assert failures(still, {**parameters, "GPS_TYPE2": 14.0}) == {"EK3_SRC1_VELXY", "EK3_SRC1_VELZ"}


@pytest.mark.parametrize(("gps_id", "asked"), [(0, False), (1, True)])
def test_a_second_receiver_needs_room_in_the_ekfs_buffer(gps_id: int, asked: bool) -> None:
    parameters = {"VISO_TYPE": 0.0, "VISO_DELAY_MS": 10.0}
    settings = config(message="gps_input", gps_id=gps_id)
    findings = check_parameters(ardupilot_rules(settings, 1), parameters.get)
    advice = {f.name: f.fix for f in findings if f.name.startswith("VISO") and not f.ok}
    assert advice == ({"VISO_TYPE": 1.0, "VISO_DELAY_MS": 100.0} if asked else {})
    assert not any(f.required for f in findings if f.name in advice)


@pytest.mark.parametrize(
    ("parameters", "fixed"),
    [
        ({"ARMING_CHECK": 1.0}, {"ARMING_CHECK": float((1 << 21) - 2 - (1 << 18))}),
        ({"ARMING_CHECK": 0.0}, {}),
        ({"ARMING_CHECK": float((1 << 18) + 8)}, {"ARMING_CHECK": 8.0}),
        ({"ARMING_CHECK": 8.0}, {}),
        ({"ARMING_SKIPCHK": 2.0}, {"ARMING_SKIPCHK": float((1 << 18) + 2)}),
        ({"ARMING_SKIPCHK": -1.0}, {}),
    ],
)
def test_a_vehicle_on_gnss_arms_without_vision(parameters, fixed):
    shadow = BridgeConfig(connection="udpout:127.0.0.1:1", mode="shadow")
    found = check_parameters(arming_rules(shadow, 2, parameters.get), parameters.get)
    assert {f.name: f.fix for f in found if not f.ok} == fixed
    assert all(f.required for f in found)
    assert arming_rules(shadow, 1, parameters.get) == []  # takes off on vision: keeps the check


@pytest.mark.parametrize(
    ("more", "fixes"),
    [
        ({"EK3_SRC_OPTIONS": 0.0}, {}),
        ({"EK3_SRC_OPTIONS": 2.0}, {}),  # of optical flow
        ({"EK3_SRC_OPTIONS": 1.0}, {"EK3_SRC_OPTIONS": 0.0}),
        ({"EK3_SRC_OPTIONS": 10.0}, {"EK3_SRC_OPTIONS": 2.0}),
        ({"SCR_ENABLE": 1.0}, {"SCR_ENABLE": 0.0}),
        ({"GPS1_TYPE": 0.0, "EK3_SRC_OPTIONS": 9.0}, {}),  # no receiver
    ],
)
def test_what_lets_the_autopilot_use_gnss_by_itself_is_found(more, fixes):
    parameters = {"GPS1_TYPE": 1.0, "EK3_SRC_OPTIONS": 0.0} | more
    found = check_parameters(gnss_rules(parameters.get), parameters.get)
    assert {f.name: f.fix for f in found if not f.ok} == fixes
    assert gnss_rules({"GPS1_TYPE": 1.0}.get) == []  # firmware that has no options


@pytest.mark.parametrize(
    ("px4", "message", "parameters", "option"),
    [
        (False, "odometry", {"EK3_SRC1_POSXY": 3.0}, "HAL_VISUALODOM_ENABLED"),
        (False, "odometry", {}, "ArduPilot 4.1"),
        (True, "odometry", {"EKF2_AGP0_CTRL": 1.0}, "CONFIG_EKF2_EXTERNAL_VISION"),
        (True, "global_position_sensor", {"EKF2_EV_CTRL": 1.0}, "CONFIG_EKF2_AUX_GLOBAL_POSITION"),
        (True, "global_position_sensor", {"EKF2_AGP_CTRL": 1.0}, None),
        (False, "gps_input", {}, None),
    ],
)
def test_firmware_that_was_built_without_the_feature_names_the_build_option(
    px4: bool, message: Any, parameters: dict[str, float], option: str | None
) -> None:
    found = missing_feature(config(message=message), parameters.get, px4=px4)
    assert (found is None) if option is None else (found is not None and option in found[1])


def test_a_small_board_is_one_required_failure_and_no_list_of_missing_parameters(
    autopilot: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mavlink_bridge.preflight.client._ANSWER_S", 0.1)
    link = DoctorFinding("connection", "ardupilot", "a heartbeat", "", True, True)
    known = ([link], VehicleState(autopilot="ardupilot"))
    monkeypatch.setattr("mavlink_bridge.preflight.doctor.check_link", lambda _: known)
    autopilot.parameters = {"EK3_SRC1_POSXY": 3.0}
    diagnosis = examine(config(autopilot.port))
    assert [f.name for f in diagnosis.findings] == ["connection", "firmware feature"]
    assert diagnosis.exit_code == 2


@pytest.mark.parametrize("kind", [mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_INT8])
@pytest.mark.parametrize("value", [0, 1, 9, -3, 100])
def test_px4_integers_travel_as_bytes(kind: int, value: int) -> None:
    wire = encode_value(value, kind, bytewise=True)
    assert decode_value(wire, kind, bytewise=True) == value
    assert decode_value(float(value), kind, bytewise=False) == value


def gimbal(fake: Any, boot_ms: int) -> list[Any]:
    return [
        mavlink.MAVLink_gimbal_device_attitude_status_message(
            0, 0, boot_ms, 32, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0, 0.0, 0.0
        )
    ]


def test_examination_and_repair(autopilot: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # What a busy machine does to the line between two threads is not the subject here.
    for name, loose in (("_ROUND_TRIP_LIMIT_MS", 1e4), ("_RATE_SHARE", 0.05), ("_LOST_SHARE", 0.9)):
        monkeypatch.setattr(f"mavlink_bridge.preflight.doctor.{name}", loose)
    monkeypatch.setattr("mavlink_bridge.preflight.doctor._MEASURE_S", 2.0)
    autopilot.parameters = {**GOOD, "EK3_SRC1_VELXY": 3.0, "VISO_DELAY_MS": 10.0}
    autopilot.extra = gimbal
    settings = config(autopilot.port)
    diagnosis = examine(settings)
    wrong = {f.name: f for f in diagnosis.findings if not f.ok}
    assert set(wrong) == {"EK3_SRC1_VELXY", "VISO_DELAY_MS"}
    assert diagnosis.exit_code == 2
    assert (wrong["VISO_DELAY_MS"].found, wrong["VISO_DELAY_MS"].needed) == ("10", "100")
    assert {"connection", "firmware", "clock", "ATTITUDE", "EKF origin", "gimbal"} <= {
        f.name for f in diagnosis.findings if f.ok
    }
    assert repair(settings, diagnosis.fixable)  # VISO_DELAY_MS is read at the start
    assert autopilot.parameters == GOOD


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "message", ["vision_position_estimate", "odometry", "gps_input", "global_position_sensor"]
)
def test_parameters_that_are_no_numbers_are_wrong_and_can_be_written(message, value):
    config = BridgeConfig(injection=InjectionConfig(message=message))
    for rules in (ardupilot_rules(config, find_source_set(config, lambda _: value)),
                  px4_rules(config, lambda _: value)):  # fmt: skip
        for finding in check_parameters(rules, lambda _: value):
            assert not finding.ok
            assert finding.fix is not None
            assert math.isfinite(finding.fix)


def test_silence_is_one_required_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mavlink_bridge.preflight.doctor._CONNECT_S", 0.3)
    diagnosis = examine(config(9))
    assert diagnosis.exit_code == 2
    assert [f.name for f in diagnosis.findings] == ["connection"]


def test_a_port_that_is_taken_is_told_as_that(monkeypatch: pytest.MonkeyPatch) -> None:

    class Tried(Bridge):
        """Starts with one attempt, however long a busy machine takes for it."""

        def start(self) -> None:
            super().start()
            assert sleep_until(lambda: bool(self.counters()["fc_open_failures"]), 30.0)

    monkeypatch.setattr("mavlink_bridge.preflight.doctor.Bridge", Tried)
    monkeypatch.setattr("mavlink_bridge.preflight.doctor._CONNECT_S", 0.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        endpoint = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        (finding,) = examine(BridgeConfig(connection=endpoint)).findings
    assert finding.found == "cannot be opened"
    assert "is the companion running" in finding.why


def test_parameters_are_asked_of_one_vehicle_and_taken_from_its_autopilot(autopilot, monkeypatch):
    """A second vehicle and a gimbal on the same link answer, too."""
    autopilot.parameters = {"A": 1.0}
    answer = autopilot.parameter

    def everybody(name: str) -> None:
        other = mavlink.MAVLink_param_value_message(b"A", 9.0, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0)
        beat = mavlink.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3)
        autopilot.send(beat, component=1, system=2)
        autopilot.send(other, component=1, system=2)
        autopilot.send(other, component=154, system=1)
        answer(name)

    autopilot.parameter = everybody
    with ParameterClient(config(autopilot.port)) as client:
        for _ in range(3):
            assert client.read("A") == 1.0
        assert client.system == 1
        client.write("A", 2.0)
        monkeypatch.setattr("mavlink_bridge.preflight.client._ANSWER_S", 0.2)
        assert client.read_known(("A", "NO_SUCH")) == {"A": 2.0}
        with pytest.raises(ParameterError, match="no such parameter"):
            client.write("NO_SUCH", 1.0)
    sets = autopilot.of("PARAM_SET")
    assert {m.target_system for m in sets} == {1}


def test_two_vehicles_on_the_link_are_a_required_failure(autopilot, monkeypatch):
    """No parameter may be read, judged or written while nobody said of which vehicle."""
    monkeypatch.setattr("mavlink_bridge.preflight.doctor._MEASURE_S", 0.6)
    autopilot.parameters = dict(GOOD)
    slow = autopilot.slow

    def both() -> None:
        slow()
        autopilot.send(mavlink.MAVLink_heartbeat_message(2, 3, 81, 4, 4, 3), component=1, system=2)

    autopilot.slow = both
    diagnosis = examine(config(autopilot.port))
    assert diagnosis.exit_code == 2
    (vehicles,) = (f for f in diagnosis.findings if f.name == "vehicles")
    assert (vehicles.found, vehicles.ok, vehicles.required) == ("several", False, True)
    assert not autopilot.of("PARAM_REQUEST_READ")
    chosen = examine(config(autopilot.port).model_copy(update={"system_id": 1}))
    assert next(f for f in chosen.findings if f.name == "vehicles").ok


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("FS_EKF_ACTION", 0.0, {"FS_EKF_ACTION", "when vision ends"}),
        ("FS_EKF_ACTION", 2.0, set()),
        ("FS_EKF_ACTION", 3.0, {"FS_EKF_ACTION", "when vision ends"}),
        ("FS_EKF_THRESH", 0.0, {"FS_EKF_THRESH"}),
        ("FS_DR_ENABLE", 2.0, {"FS_DR_ENABLE"}),
        ("FENCE_ENABLE", 0.0, {"FENCE_ENABLE"}),
        ("FENCE_TYPE", 4.0, {"FENCE_TYPE"}),
        ("FENCE_ACTION", 1.0, {"FENCE_ACTION"}),
    ],
)
def test_what_happens_when_vision_ends_is_told_and_never_written(name, value, told):
    findings = failsafes(config(), {**GOOD, name: value}.get)
    assert {f.name for f in findings if not f.ok} == told
    assert not any(f.required or f.fix is not None for f in findings)
    ends = next(f for f in findings if f.name == "when vision ends")
    lands = {0.0: "drifts on", 2.0: "ALT_HOLD"} if name == "FS_EKF_ACTION" else {}
    assert lands.get(value, "LAND") in ends.found
    assert failsafes(config(), {}.get) == []
    assert failsafes(config().model_copy(update={"mode": "off"}), GOOD.get) == []


PX4_GOOD = {
    "COM_POS_LOW_ACT": 5.0,
    "GF_ACTION": 2.0,
    "EKF2_NOAID_TOUT": 5e6,
    "COM_POS_FS_EPH": 5.0,
    "GF_MAX_VER_DIST": 120.0,
    "COM_POSCTL_NAVL": 0.0,
    "EKF2_GPS_CTRL": 6.0,
}


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("COM_POSCTL_NAVL", 1.0, set()),
        ("COM_POSCTL_NAVL", 7.0, {"when vision ends"}),
        ("COM_POS_LOW_ACT", 3.0, {"COM_POS_LOW_ACT"}),  # as it comes
        ("GF_ACTION", 3.0, {"GF_ACTION"}),
        ("GF_MAX_VER_DIST", 0.0, {"GF_MAX_VER_DIST"}),  # as it comes
        ("EKF2_NOAID_TOUT", 1e7, {"EKF2_NOAID_TOUT"}),
        ("COM_POS_FS_EPH", -1.0, {"COM_POS_FS_EPH"}),
        ("COM_POS_FS_EPH", 50.0, {"COM_POS_FS_EPH"}),
        ("EKF2_GPS_CTRL", 3.0, {"EKF2_GPS_CTRL"}),
    ],
)
def test_what_px4_does_when_vision_ends_is_told_likewise(name, value, told):
    findings = px4_failsafes(config(), {**PX4_GOOD, name: value}.get)
    assert {f.name for f in findings} == {*PX4_GOOD, "when vision ends"} - {"COM_POSCTL_NAVL"}
    assert {f.name for f in findings if not f.ok} == told
    assert not any(f.required or f.fix is not None for f in findings)
    ends = next(f for f in findings if f.name == "when vision ends")
    assert {1.0: "LAND", 7.0: "7"}.get(value, "altitude mode") in ends.found
    beside = px4_failsafes(config(message="global_position_sensor"), PX4_GOOD.get)
    assert "EKF2_GPS_CTRL" not in {f.name for f in beside}


def test_px4_is_asked_for_its_own_failsafes_and_has_no_source_sets(autopilot, monkeypatch):
    link = DoctorFinding("connection", "px4", "a heartbeat", "", True, True)
    known = ([link], VehicleState(autopilot="px4"))
    monkeypatch.setattr("mavlink_bridge.preflight.doctor.check_link", lambda _: known)
    autopilot.autopilot = mavlink.MAV_AUTOPILOT_PX4
    autopilot.version = (1, 16, 0)
    settings = config(autopilot.port)
    rules = {rule.names[0]: 0.0 for rule in px4_rules(settings, {}.get)}
    autopilot.parameters = {**rules, **PX4_GOOD, "COM_POSCTL_NAVL": 1.0, "FS_EKF_ACTION": 0.0}
    found = {f.name: f.found for f in examine(settings).findings}
    assert found["when vision ends"].startswith("LAND")
    assert "FS_EKF_ACTION" not in found
    assert "source switch" not in found
    switched = settings.model_copy(update={"switch": SourceSwitchConfig(enabled=True)})
    (finding,) = (f for f in examine(switched).findings if f.name == "source switch")
    assert (finding.ok, finding.required) == (False, True)
