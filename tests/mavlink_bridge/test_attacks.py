"""Attacks on the link: each was possible once, and beside each stands what must still work."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v10 import ardupilotmega as first_version
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import SenderRefusal
from mavlink_bridge.components import Components
from mavlink_bridge.config import BridgeConfig, InjectionEnableConfig, SigningConfig
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.link.framing import FrameReader
from mavlink_bridge.link.signing import ReplayWindow
from tests.mavlink_bridge.simulated import HOME, METRE, Flight, heartbeat, origin_message

KEY = bytes(range(1, 33))
COMMAND = mavlink.MAV_CMD_USER_1


# --- the origin -------------------------------------------------------------------------------


def test_a_forged_disarming_opens_nothing_in_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the autopilot's own heartbeats, a stranger's that says disarmed."""
    flight = Flight(monkeypatch)
    flight.armed = True
    flight.run(12.0)
    before, told = flight.end.origin.origin, len(flight.alerts)
    for _ in range(40):
        flight.say(heartbeat(armed=False))
        flight.say(origin_message(60.0))
        flight.run(0.1)
    assert flight.end.origin.origin == before
    forged = [AlertId.ORIGIN_REFUSED, AlertId.ARMING_ALTERNATES]
    assert [a.id for a in flight.alerts[told:]] == forged
    assert flight.shared.tracker.snapshot(flight.now_ns).armed


@pytest.mark.parametrize(("system", "component"), [(2, 1), (255, 190), (1, 25), (1, 191)])
def test_another_systems_arming_does_not_shut_what_is_open_on_the_ground(
    monkeypatch: pytest.MonkeyPatch, system: int, component: int
) -> None:
    """Only the heartbeat of the autopilot that is followed tells whether it is armed."""
    flight = Flight(monkeypatch)
    flight.run(12.0)
    for _ in range(40):
        flight.say(heartbeat(armed=True), system=system, component=component)
        flight.run(0.1)
        assert not flight.shared.tracker.snapshot(flight.now_ns).armed
    flight.say(heartbeat(armed=True))
    assert flight.shared.tracker.snapshot(flight.now_ns).armed


@pytest.mark.parametrize("forged", [True, False])
def test_armed_and_disarmed_in_turn_is_told_and_arming_twice_is_not(monkeypatch, forged):
    """Of the autopilot's own ids, which an unsigned link cannot tell apart: what is open on the
    ground is shut by it, and the operator learns why.
    """
    flight = Flight(monkeypatch)
    flight.run(12.0)
    for turn in range(4):
        if forged:
            flight.say(heartbeat(armed=True))
        else:
            flight.armed = turn % 2 == 0
        flight.run(1.1)
    told = flight.told(AlertId.ARMING_ALTERNATES)
    assert told == [alert(AlertId.ARMING_ALTERNATES, system=1)] * forged
    flight.run(4.0)
    assert not flight.shared.tracker.snapshot(flight.now_ns).armed  # what lasts is believed


def test_an_origin_that_moves_on_the_ground_or_with_a_reboot_is_followed(monkeypatch):
    flight = Flight(monkeypatch)
    flight.run(12.0)
    flight.say(heartbeat(armed=False))
    flight.say(origin_message(60.0))
    moved = flight.end.origin.origin
    assert moved.latitude_deg == pytest.approx(HOME[0] + 60.0 * METRE)
    flight.say(heartbeat(armed=True))
    flight.end.origin.forget()  # as a reboot does
    flight.say(origin_message(0.0))
    assert flight.end.origin.origin is not None
    assert flight.end.counters["origins_refused"] == 0


# --- orders -----------------------------------------------------------------------------------


class Orders:
    """A flight in mode rc, and commands of other systems to its components."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **options: Any) -> None:
        self.enable = InjectionEnable(InjectionEnableConfig(), lambda _: None)
        self.flight = Flight(monkeypatch, self.enable, **options)
        self.flight.run(2.0)

    def command(
        self, system: int, command: int, component: int, *, to: int = 1, wanted: float = 1.0
    ) -> list[int]:
        """The results that a COMMAND_LONG is answered with."""
        message = mavlink.MAVLink_command_long_message(
            to, component, command, 0, wanted, *[0.0] * 6
        )
        before = len(self.flight.link.sent)
        self.flight.say(message, system=system, component=190)
        sent = [m for _, m, _ in self.flight.link.sent[before:]]
        return [m.result for m in sent if m.get_type() == "COMMAND_ACK"]


def test_the_ground_stations_order_is_obeyed(monkeypatch: pytest.MonkeyPatch) -> None:
    orders = Orders(monkeypatch)
    assert orders.command(255, COMMAND, 197, to=2) == []  # another vehicle's
    assert orders.command(255, mavlink.MAV_CMD_USER_2, 197) == [mavlink.MAV_RESULT_UNSUPPORTED]
    assert orders.command(255, COMMAND, 197, wanted=math.nan) == [mavlink.MAV_RESULT_DENIED]
    assert not orders.enable.enabled
    for wanted in (1.0, 1.0, 0.0):  # sent again
        assert orders.command(255, COMMAND, 197, wanted=wanted) == [mavlink.MAV_RESULT_ACCEPTED]
        assert orders.enable.enabled is (wanted == 1.0)
    second = Orders(monkeypatch, ground_systems=(254, 66))
    assert second.command(66, COMMAND, 197) == [mavlink.MAV_RESULT_ACCEPTED]


@pytest.mark.parametrize(
    ("command", "component"),
    [
        (COMMAND, 197),
        (mavlink.MAV_CMD_CAMERA_TRACK_POINT, 100),
        (mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 197),
    ],
)
def test_orders_of_other_systems_are_denied_and_told_once(monkeypatch, command, component):
    orders = Orders(monkeypatch)
    for _ in range(3):
        assert orders.command(66, command, component) == [mavlink.MAV_RESULT_DENIED]
    assert not orders.enable.enabled
    told = orders.flight.told(AlertId.SENDER_REFUSED)
    assert told == [alert(AlertId.SENDER_REFUSED, system=66, why=SenderRefusal.NOT_ALLOWED)]
    assert orders.command(66, mavlink.MAV_CMD_REQUEST_MESSAGE, 100) != []  # a question


def test_with_signing_an_unsigned_ground_link_gives_no_orders(monkeypatch, tmp_path):
    signing = SigningConfig(key_file=tmp_path / "key")
    orders = Orders(monkeypatch, signing=signing, ground_connection="udpout:127.0.0.1:1")
    orders.flight.end.components = Components(orders.flight.shared, ground=True)
    assert orders.command(255, COMMAND, 197) == [mavlink.MAV_RESULT_DENIED]
    refused = alert(AlertId.SENDER_REFUSED, system=255, why=SenderRefusal.NOT_SIGNED)
    assert refused in orders.flight.alerts
    assert not orders.enable.enabled


def test_state_files_of_two_links_differ(tmp_path: Path) -> None:
    one = SigningConfig(key_file=tmp_path / "key", state_file=tmp_path / "seen")
    with pytest.raises(ValueError, match="state_file each"):
        BridgeConfig(signing=one, ground_signing=one)
    shared = SigningConfig(key_file=tmp_path / "key")
    BridgeConfig(signing=shared, ground_signing=shared)


# --- signatures over restarts -----------------------------------------------------------------


def signed(stamp: int, system: int = 255) -> bytes:
    codec = mavlink.MAVLink(None, system, 190)
    codec.signing.secret_key, codec.signing.sign_outgoing = KEY, True
    codec.signing.timestamp, codec.signing.link_id = stamp, 1
    message = mavlink.MAVLink_command_long_message(1, 197, COMMAND, 0, 1.0, *[0.0] * 6)
    return bytes(message.pack(codec))


@contextlib.contextmanager
def process(path: Path) -> Iterator[FrameReader]:
    """One life of a signed link's reader."""
    window = ReplayWindow(path)
    yield FrameReader(None, KEY, window)
    window.close()


@pytest.fixture
def unset_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mavlink_bridge.link.signing.time.time", lambda: 0.0)


STAMP = 1_000_000_000


@pytest.mark.usefixtures("unset_clock")
def test_a_recorded_order_is_refused_after_a_restart_though_the_clock_is_unset(tmp_path):
    """Our own stamps begin beyond all that was seen, so that an autopilot follows that does not
    know the time, and is heard at once.
    """
    path = tmp_path / "seen"
    with process(path) as first:
        assert first.feed(signed(STAMP))
    assert path.stat().st_mode & 0o777 == 0o600
    with process(path) as second:
        assert not second.feed(signed(STAMP))
        assert not second.feed(signed(STAMP - 10_000_000, system=254))  # when it was not heard
        assert second.signing_timestamp > STAMP
        assert second.feed(signed(second.signing_timestamp + 1, system=1))
        assert second.feed(signed(STAMP + 300_000)), "3 s later: the station goes on"


@pytest.mark.usefixtures("unset_clock")
def test_an_order_that_comes_in_the_last_write_is_not_taken_again(tmp_path, monkeypatch):
    """The end came while the disk wrote what was heard before it."""
    window, late, wrote = ReplayWindow(tmp_path / "seen"), [], threading.Event()
    first = FrameReader(None, KEY, window)

    def meanwhile(_: int) -> None:
        if wrote.is_set():
            return
        late.extend(first.feed(signed(STAMP + 600_000, system=254)))
        with contextlib.suppress(RuntimeError):  # the writer does not wait for itself
            window.close()
        wrote.set()

    monkeypatch.setattr("mavlink_bridge.atomic_file.os.fsync", meanwhile)
    assert first.feed(signed(STAMP))
    assert wrote.wait(20.0)
    window.close()
    assert len(late) == 1
    with process(tmp_path / "seen") as second:
        assert not second.feed(signed(STAMP + 600_000, system=254))


@pytest.mark.usefixtures("unset_clock")
@pytest.mark.parametrize(
    "content",
    [
        "",
        "[1]",
        "\0\0",
        "[" * 100_000,
        '{"1:2:3": null}',
        '{"1:1:1": 1e400}',
        '{"1:1:1": 1000000000000000000000000000000}',  # our own begin beyond it, and none fits
        '{"1:1:1": -5}',
        '{"1:1:1": 3.7}',
        '{"1:1:1": true}',
        '{"1:1:1000": 5}',
        '{"1:1": 5}',
    ],
)
def test_a_damaged_state_is_told_and_begun_anew(tmp_path, content, caplog):
    path = tmp_path / "seen"
    path.write_text(content)
    with caplog.at_level(logging.WARNING), process(path) as reader:
        assert "restarted, messages" in caplog.text
        assert reader.feed(signed(STAMP))
    with process(path) as again:
        assert not again.feed(signed(STAMP))


def test_a_place_that_cannot_be_written_is_told_and_the_link_goes_on(tmp_path, caplog):
    with caplog.at_level(logging.WARNING), process(tmp_path / "none" / "seen") as reader:
        assert reader.feed(signed(10**14))
    assert caplog.text.count("set signing.state_file") == 1


def test_mavlink_1_is_refused_where_signing_is_on() -> None:
    message = first_version.MAVLink_command_long_message(1, 197, COMMAND, 0, 1.0, *[0.0] * 6)
    frame = bytes(message.pack(first_version.MAVLink(None, 255, 190)))
    assert FrameReader().feed(frame), "it is one that would be taken without signing"
    reader = FrameReader(None, KEY)
    assert not reader.feed(frame)
    assert reader.counters.unsigned == 1
