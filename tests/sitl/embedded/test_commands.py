"""Every command and guided message does what ArduPilot does with it: result codes and effects."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.control.mode import Mode

ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4
RELATIVE, NO_FRAME = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, mavlink.MAV_FRAME_MISSION
PLACE = (473981000, 85460000)  # north-east of home, degrees * 1e7
NAN = math.nan


class SerialPort:
    """What a handler needs of a link."""

    def __init__(self):
        self.sent, self.intervals = [], {}

    def send(self, message):
        self.sent.append(message)

    def set_interval(self, message_id, seconds):
        self.intervals[message_id] = seconds


@pytest.fixture
def flying(bench):
    b = bench({"MNT1_TYPE": 7}, seed=3)
    b.take_off(20.0)
    return b


@pytest.fixture
def grounded(bench):
    b = bench({"MNT1_TYPE": 7}, seed=3)
    assert b.run(60, lambda: b.vehicle.tick % 50 == 0 and not b.failures())
    return b


def told(bench, message):
    """The link after the vehicle has handled the message."""
    message.pack(mavlink.MAVLink(None, 255, 190))  # which names the sender
    link = SerialPort()
    bench.whole.commands.handle(link, message)
    return link


def result(bench, number, *parameters, frame=None, x=0, y=0):
    """MAV_RESULT of a COMMAND_LONG, or of a COMMAND_INT where there is a frame."""
    p = [*parameters, *[0.0] * (7 - len(parameters))]
    if frame is None:
        message = mavlink.MAVLink_command_long_message(1, 1, number, 0, *p)
    else:
        message = mavlink.MAVLink_command_int_message(1, 1, frame, number, 0, 0, *p[:4], x, y, p[6])
    (ack,) = [m for m in told(bench, message).sent if m.get_type() == "COMMAND_ACK"]
    assert (ack.command, ack.target_system, ack.target_component) == (number, 255, 190)
    return ack.result


def test_commands_in_flight(flying):
    m = mavlink
    v = flying.vehicle
    reposition = (-1.0, 0.0, 0.0, NAN, 0.0, 0.0, 40.0)
    assert result(flying, m.MAV_CMD_DO_REPOSITION, *reposition) == UNSUPPORTED
    for frame, code in ((NO_FRAME, DENIED), (RELATIVE, ACCEPTED)):
        place = {"frame": frame, "x": PLACE[0], "y": PLACE[1]}
        assert result(flying, m.MAV_CMD_DO_REPOSITION, *reposition, **place) == code
    here, goal = v.estimator.position, v.modes.target
    assert goal[0] > here[0] + 20
    assert goal[1] > here[1] + 20
    assert goal[2] < here[2] - 15
    assert result(flying, m.MAV_CMD_NAV_TAKEOFF, *[0.0] * 6, 30.0) == FAILED  # it flies already
    assert result(flying, m.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == FAILED
    assert result(flying, m.MAV_CMD_COMPONENT_ARM_DISARM, 0) == FAILED
    assert result(flying, m.MAV_CMD_DO_CHANGE_SPEED, 1, 3.0) == ACCEPTED
    assert result(flying, m.MAV_CMD_DO_CHANGE_SPEED, 1, 0.0) == FAILED
    assert result(flying, m.MAV_CMD_CONDITION_YAW, 90, 0, 1, 0) == ACCEPTED
    assert result(flying, m.MAV_CMD_MISSION_START) == FAILED  # there is none
    assert result(flying, m.MAV_CMD_DO_SET_MISSION_CURRENT, 1) == FAILED
    assert result(flying, m.MAV_CMD_DO_SET_MODE, 1, 77) == FAILED
    assert result(flying, m.MAV_CMD_DO_SET_MODE, 1, int(Mode.STABILIZE)) == ACCEPTED
    assert v.modes.mode.name == "STABILIZE"
    assert result(flying, m.MAV_CMD_DO_REPOSITION, *reposition, **place) == DENIED
    change = (-1.0, 1.0, *reposition[2:])  # MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
    assert result(flying, m.MAV_CMD_DO_REPOSITION, *change, **place) == ACCEPTED
    assert v.modes.mode.name == "GUIDED"
    assert result(flying, m.MAV_CMD_NAV_RETURN_TO_LAUNCH) == ACCEPTED
    assert v.modes.mode.name == "RTL"
    assert result(flying, m.MAV_CMD_NAV_LAND) == ACCEPTED
    assert v.modes.mode.name == "LAND"


def test_commands_on_the_ground(grounded):
    m = mavlink
    v = grounded.vehicle
    assert result(grounded, m.MAV_CMD_SET_EKF_SOURCE_SET, 4) == DENIED
    assert result(grounded, m.MAV_CMD_SET_EKF_SOURCE_SET, 2) == ACCEPTED
    assert v.estimator.sources.source_set == 2
    assert grounded.said("Using EKF Source Set 2")
    assert result(grounded, m.MAV_CMD_SET_EKF_SOURCE_SET, 1) == ACCEPTED
    origin = {"frame": 0, "x": PLACE[0], "y": PLACE[1]}
    assert result(grounded, 611, **origin) == FAILED  # GNSS has set one
    assert result(grounded, 611, frame=0, x=910_000_000) == DENIED
    assert result(grounded, 611) == UNSUPPORTED
    assert result(grounded, m.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, 0, 0, 500.0, **origin) == ACCEPTED
    assert v.modes.home.latitude_deg == pytest.approx(47.3981)
    assert result(grounded, m.MAV_CMD_DO_SET_HOME, 0) == UNSUPPORTED
    assert result(grounded, m.MAV_CMD_DO_SET_HOME, 1) == ACCEPTED
    external = m.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
    assert result(grounded, external, 0, 0, 5, 0, **origin) == FAILED  # it is aided
    assert result(grounded, m.MAV_CMD_NAV_TAKEOFF, *[0.0] * 6, 30.0) == FAILED
    assert result(grounded, m.MAV_CMD_DO_SET_MODE, 1, int(Mode.GUIDED)) == ACCEPTED
    assert result(grounded, m.MAV_CMD_COMPONENT_ARM_DISARM, 1) == ACCEPTED
    assert result(grounded, m.MAV_CMD_NAV_TAKEOFF, *[0.0] * 6, 30.0) == ACCEPTED
    assert result(grounded, m.MAV_CMD_COMPONENT_ARM_DISARM, 0) == ACCEPTED
    assert not v.modes.armed
    assert result(grounded, m.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == ACCEPTED
    assert v.reboot_ordered


# --- Arming refusals with ArduPilot's texts (ardupilot.md, "Arming refusals seen") --------------


def guided(b, home=None):
    if home is not None:
        b.vehicle.estimator.set_origin(home)
    b.vehicle.modes.mode = Mode.GUIDED
    return b


def test_gyros_settle_for_25_seconds(bench, vision_only, home):
    b = guided(bench(vision_only), home)
    b.vision()
    b.run(20)
    assert b.failures() == ["Gyros inconsistent"]
    b.run(6)
    assert b.failures() == []


@pytest.mark.parametrize(
    ("parameters", "vision", "told"),
    [
        ({"SIM_GPS1_ENABLE": 0}, None, {"GPS 1: Bad fix", "Need Position Estimate"}),
        ({}, "no origin", {"AHRS: waiting for home"}),
        ({"EK3_SRC1_VELXY": 3}, "sent", {"AHRS: EK3 sources require GPS"}),
        ({"VISO_TYPE": 0}, "sent", {"AHRS: EK3 sources require VisualOdom"}),
    ],
    ids=["no GNSS", "no origin", "velocity from GNSS", "no vision configured"],
)
def test_what_is_missing_is_named(bench, vision_only, home, parameters, vision, told):
    b = bench({**(vision_only if vision else {}), **parameters})
    guided(b, home if vision == "sent" else None)
    if vision:
        b.vision()
    b.run(60 if vision is None else 30)
    assert told <= set(b.failures())


def test_a_gap_over_300_ms(bench, vision_only, home):
    b = guided(bench(vision_only), home)
    feed = b.vision()
    b.run(30)
    assert b.failures() == []
    feed.on = False
    b.run(0.5)
    assert b.failures() == ["VisOdom: not healthy"]


def test_vision_under_4_hertz_does_not_arm(bench, vision_only, home):
    b = guided(bench(vision_only), home)
    b.vision(period_ticks=100)
    b.run(30)
    refused = []
    b.run(5, lambda: refused.append("VisOdom: not healthy" in b.failures()) or False)
    assert np.mean(refused) > 0.5


def test_noise_far_above_what_is_claimed(bench, vision_only, home):
    b = guided(bench(vision_only), home)
    b.vision(sigma=6.0)
    b.run(30)
    seen = set()
    b.run(20, lambda: seen.update(b.failures()) or False)
    assert "EKF position variance" in seen
