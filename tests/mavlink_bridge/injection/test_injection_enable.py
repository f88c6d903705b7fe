"""Who opens and closes the gate of mode ``rc``: the newest word of channel or command."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import RcChannel
from mavlink_bridge.config import InjectionEnableConfig
from mavlink_bridge.injection.injection_enable import InjectionEnable

COMMAND = mavlink.MAV_CMD_USER_1


def enable(**options: object) -> tuple[InjectionEnable, list[Alert]]:
    told: list[Alert] = []
    return InjectionEnable(InjectionEnableConfig(**options), told.append), told  # type: ignore[arg-type]


def channels(pulse: int, count: int = 18) -> tuple[int, ...]:
    return tuple(pulse if i == 9 else 1500 for i in range(1, count + 1))


def test_channel_is_followed_and_each_change_is_told_once() -> None:
    it, told = enable()
    for pulse in (1100, 1100, 1900, 1900, 1100, 1100):
        it.channels(channels(pulse))
    assert told == [
        alert(of, by=RcChannel(9)) for of in (AlertId.INJECTION_ON, AlertId.INJECTION_OFF)
    ]


def test_a_pulse_at_the_threshold_does_not_flutter() -> None:
    it, told = enable(inject_above_us=1700)
    for pulse in (1690, 1705, 1690, 1702, 1655):
        it.channels(channels(pulse))
    assert told == [alert(AlertId.INJECTION_ON, by=RcChannel(9))]
    it.channels(channels(1640))
    assert not it.open


@pytest.mark.parametrize("silent", [channels(0), channels(65535), channels(2300), (), (1900,) * 8])
def test_a_receiver_that_says_nothing_changes_nothing(silent: tuple[int, ...]) -> None:
    it, _ = enable()
    it.channels(silent)
    assert not it.open
    it.channels(channels(1900))
    it.channels(silent)
    assert it.open


def test_the_newest_word_counts() -> None:
    it, _ = enable()
    assert it.command(COMMAND, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    it.channels(channels(1100))  # the first look at a switch that is off is no word
    assert it.open
    it.channels(channels(1900))
    assert it.command(COMMAND, 0.0) == mavlink.MAV_RESULT_ACCEPTED
    it.channels(channels(1900))  # still on, not moved
    assert not it.open
    it.channels(channels(1100))
    it.channels(channels(1900))
    assert it.open


@pytest.mark.parametrize("wanted", [math.nan, math.inf, 2.0, -1.0, 0.5])
def test_only_0_and_1_are_commands(wanted: float) -> None:
    it, told = enable()
    assert it.command(COMMAND, wanted) == mavlink.MAV_RESULT_DENIED
    assert told == []


def test_other_commands_and_a_gate_without_command_are_unsupported() -> None:
    it, _ = enable(command="user_3")
    assert it.command(COMMAND, 1.0) == mavlink.MAV_RESULT_UNSUPPORTED
    assert it.command(mavlink.MAV_CMD_USER_3, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    never, _ = enable(command=None)
    assert never.command(COMMAND, 1.0) == mavlink.MAV_RESULT_UNSUPPORTED
    assert not never.open
