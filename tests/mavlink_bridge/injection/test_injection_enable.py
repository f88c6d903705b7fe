"""Who opens and closes the gate of mode ``rc``: the newest word of channel or command."""

from __future__ import annotations

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
        it.on_rc_channels(channels(pulse))
    assert told == [
        alert(of, by=RcChannel(9)) for of in (AlertId.INJECTION_ON, AlertId.INJECTION_OFF)
    ]


def test_a_pulse_at_the_threshold_does_not_flutter() -> None:
    it, told = enable(inject_above_us=1700)
    for pulse in (1690, 1705, 1690, 1702, 1655):
        it.on_rc_channels(channels(pulse))
    assert told == [alert(AlertId.INJECTION_ON, by=RcChannel(9))]
    it.on_rc_channels(channels(1640))
    assert not it.enabled


def test_the_newest_word_counts() -> None:
    it, _ = enable()
    assert it.command(COMMAND, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    it.on_rc_channels(channels(1100))  # the first look at a switch that is off is no word
    assert it.enabled
    it.on_rc_channels(channels(1900))
    assert it.command(COMMAND, 0.0) == mavlink.MAV_RESULT_ACCEPTED
    it.on_rc_channels(channels(1900))  # still on, not moved
    assert not it.enabled
    it.on_rc_channels(channels(1100))
    it.on_rc_channels(channels(1900))
    assert it.enabled
