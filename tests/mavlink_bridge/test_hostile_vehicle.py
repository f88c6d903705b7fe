"""Who speaks with the vehicle's own ids on an unsigned link: nothing wrong is believed, nothing
grows, and the operator is told once, not for every frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.targets.numbers import TargetNumbers
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import CameraConfig
from mavlink_bridge.shared import clicked_numbers
from mavlink_bridge.status import OperatorStatus
from tests.mavlink_bridge.simulated import HOME, MS, Flight, heartbeat, origin_message

TWINS = alert(AlertId.DUPLICATE_SYSTEM_ID, system=1)
PLACE = (round(HOME[0] * 1e7), round(HOME[1] * 1e7))
Attack = Callable[[Flight, int], None]


@pytest.fixture
def flight(monkeypatch: pytest.MonkeyPatch) -> Flight:
    """Armed, on vision alone, for some seconds."""
    return flown(monkeypatch)


def flown(monkeypatch: pytest.MonkeyPatch, *, armed: bool = True, **options: Any) -> Flight:
    flight = Flight(monkeypatch, **options)
    flight.armed, flight.origin = armed, (*HOME, 488.0)
    flight.run(4.0)
    flight.alerts.clear()
    return flight


def told(flight: Flight) -> list[Alert]:
    """What the operator was told beside what every flight tells."""
    usual = (AlertId.EKF_FOLLOWS, AlertId.YAW_UNCHECKED)
    return [a for a in flight.alerts if a.id not in usual]


def version(major: int) -> Any:
    empty = [0] * 8
    return mavlink.MAVLink_autopilot_version_message(
        0, major << 24 | 5 << 16, 0, 0, 0, empty, empty, empty, 0, 0, 0
    )


def stamped(flight: Flight, off_s: float) -> None:
    """Three attitudes in a row, of another boot time."""
    boot_ms = flight.boot_ns(flight.now_ns) // MS + round(off_s * 1e3)
    for later in range(3):
        flight.say(mavlink.MAVLink_attitude_message(boot_ms + later, 0.0, 0.0, -1.0, 0, 0, 0))


# --- what is injected -----------------------------------------------------------------------------


@pytest.mark.parametrize("off_s", [-50.0, 500.0])
def test_no_burst_of_forged_stamps_is_a_reboot_that_makes_room_for_a_forged_origin(flight, off_s):
    begun_ns = flight.now_ns
    for _ in range(10):
        stamped(flight, off_s)
        flight.say(origin_message(60.0))
        flight.run(0.3)
    assert flight.end.counters["reboots"] == 0
    assert {round(m.x) for _, m in flight.vision(begun_ns)} == {0}
    assert flight.attitude_error() < 0.005
    assert told(flight) == [alert(AlertId.ORIGIN_REFUSED, metres=pytest.approx(60.0, abs=0.5))]


def test_a_clock_that_jumps_alone_is_followed_half_a_second_later(flight: Flight) -> None:
    """The false alarm of the above: the vehicle's own time, which no other contradicts."""
    flight.reboot()
    flight.run(0.4)
    assert flight.end.counters["reboots"] == 0
    flight.run(0.2)
    assert flight.end.counters["reboots"] == 1
    assert flight.alerts[0].id is AlertId.FC_REBOOTED


@pytest.mark.parametrize("says", [heartbeat(12), version(3)], ids=["make", "firmware"])
def test_another_make_or_firmware_of_the_vehicles_ids_changes_nothing_that_is_sent(flight, says):
    flight.say(version(4))
    flight.run(1.0)
    begun_ns, before = flight.now_ns, flight.shared.tracker.snapshot(flight.now_ns)
    for _ in range(20):
        flight.say(says)
        flight.run(0.1)
    after = flight.shared.tracker.snapshot(flight.now_ns)
    assert (after.autopilot, after.version) == (before.autopilot, before.version)
    assert len({m.covariance[0] for _, m in flight.vision(begun_ns)}) == 1
    assert told(flight) == [TWINS]


def test_another_firmware_after_a_reboot_is_asked_for_and_taken(flight: Flight) -> None:
    flight.say(version(4))
    flight.reboot()
    flight.run(1.0)
    flight.say(version(5))
    flight.run(1.0)
    assert flight.shared.tracker.snapshot(flight.now_ns).version == (5, 5, 0)
    assert TWINS not in flight.alerts


@pytest.mark.parametrize("lie", [2**63 - 1, -(2**63)])
def test_timesync_answers_that_the_stamps_contradict_are_told_and_not_taken(flight, lie):
    flight.answers_timesync = False
    begun_ns, seen, ignored = flight.now_ns, len(flight.link.sent), flight.shared.tracker.ignored
    for step in range(800):
        flight.run(0.01)
        for _, message, _ in flight.link.sent[seen:]:
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                truth = flight.boot_ns(flight.now_ns)
                said = lie if step % 200 < 150 else truth
                flight.say(mavlink.MAVLink_timesync_message(said, message.ts1))
        seen = len(flight.link.sent)
    assert flight.shared.tracker.ignored == ignored
    assert flight.shared.tracker.clock.rate == 1.0
    assert flight.attitude_error() < 0.005
    assert len(flight.vision(begun_ns)) >= 78
    assert told(flight) == [alert(AlertId.TIMESYNC_CONTRADICTS)]


def test_the_distances_of_two_sensors_that_look_down_are_not_mixed(flight: Flight) -> None:
    """ArduPilot streams each; the ground would jump by their difference."""

    def measured(seconds: float, sensors: tuple[int, ...]) -> set[float | None]:
        said: set[float | None] = set()
        for _ in range(int(10 * seconds)):
            for sensor in sensors:
                distance_cm = 500 if sensor else 6000
                boot_ms = flight.boot_ns(flight.now_ns) // MS
                flight.say(
                    mavlink.MAVLink_distance_sensor_message(
                        boot_ms, 5, 10_000, distance_cm, 0, sensor, 25, 0
                    )
                )
                said.add(flight.shared.tracker.snapshot(flight.now_ns).rangefinder_m)
            flight.run(0.1)
        return said

    assert measured(2.0, (0, 1)) == {60.0}
    assert measured(4.0, (1,)) == {60.0, 5.0}, "the first one fell silent"
    assert measured(1.0, (1, 0)) == {5.0}


def test_a_longer_texts_middle_chooses_no_source_set(flight: Flight) -> None:
    chosen = flight.end.sources.current
    for sequence in range(1, 255):
        text = mavlink.MAVLink_statustext_message(6, b"Using EKF Source Set 2", 7, sequence)
        flight.say(text)
    assert flight.end.sources.current == chosen
    flight.say(mavlink.MAVLink_statustext_message(6, b"Using EKF Source Set 2"))
    assert flight.end.sources.current == 2


# --- what is told ---------------------------------------------------------------------------------


def orders(flight: Flight, turn: int) -> None:
    """Of 240 systems that may give none."""
    order = mavlink.MAVLink_command_long_message(1, 197, 31010, 0, 1.0, *[0.0] * 6)
    flight.say(order, system=2 + turn % 240, component=190)


def hints(flight: Flight, _: int) -> None:
    hint = mavlink.MAVLink_command_int_message(
        1, 197, 0, 43003, 0, 0, 0, 0, 10.0, 0, 900_000_000, 0, 0.0
    )
    flight.say(hint, system=255, component=190)


def acknowledgements(flight: Flight, _: int) -> None:
    """To what nobody ordered."""
    for command in (42007, 195, 197):
        flight.say(mavlink.MAVLink_command_ack_message(command, 4))


def origins(flight: Flight, turn: int) -> None:
    flight.say(origin_message(60.0 * (turn % 2)))


def makes(flight: Flight, turn: int) -> None:
    flight.say(version(turn % 7))
    flight.say(heartbeat(turn % 20))


def heartbeats(flight: Flight, turn: int) -> None:
    """Of 250 autopilots, and with the ids of our own components."""
    flight.say(heartbeat(), system=2 + turn % 250)
    flight.say(heartbeat(8), component=(191, 197, 100)[turn % 3])


def estimators(flight: Flight, turn: int) -> None:
    flags, ratio = (0, 9.0) if turn % 2 else (0x33F, 0.1)
    flight.say(mavlink.MAVLink_ekf_status_report_message(flags, ratio, ratio, ratio, 0, math.nan))


def gimbals(flight: Flight, turn: int) -> None:
    """Of 250 components with 256 devices each."""
    q = [0.0] * 4 if turn % 5 == 0 else [1.0, 0.0, 0.0, 0.0]
    status = mavlink.MAVLink_gimbal_device_attitude_status_message(
        0, 0, 0, 0, q, 0, 0, 0, 0, 0, 0, turn % 256
    )
    flight.say(status, component=255 - turn % 250)


def reboots(flight: Flight, turn: int) -> None:
    stamped(flight, 100.0 * (-1) ** turn)


@pytest.mark.parametrize(
    ("attack", "most"),
    [
        (orders, 4),
        (hints, 10),
        (acknowledgements, 0),
        (origins, 3),
        (makes, 2),
        (heartbeats, 2),
        (estimators, 2),
        (gimbals, 1),
        (reboots, 1),
    ],
)
def test_a_flood_is_told_in_a_few_lines_and_nothing_grows(monkeypatch, attack, most):
    flight = flown(monkeypatch, armed=attack is not origins, camera=CameraConfig(mount="gimbal"))
    flight.alerts.clear()
    for turn in range(120):
        attack(flight, turn)
        if turn % 5 == 0:
            flight.run(0.07)
    assert len(told(flight)) <= most, told(flight)
    assert flight.longest() <= 512
    assert len(flight.shared.tracker.other_gimbals) <= 8


def test_a_receiver_that_comes_and_goes_is_told_as_lost_and_a_short_gap_is_not(monkeypatch):
    flight = Flight(monkeypatch)
    flight.gnss_north_m, flight.armed = 0.0, True
    flight.run(10.0)
    none = mavlink.MAVLink_gps_raw_int_message(
        2**64 - 1, 0, *PLACE, 2**31 - 1, *[65535] * 4, 255, -(2**31), *[2**32 - 1] * 2
    )

    def lost(every: int) -> list[Alert]:
        flight.alerts.clear()
        for step in range(600):
            flight.run(0.01)
            if step % every == 5:
                flight.say(none)
        return flight.told(AlertId.GNSS_LOST, AlertId.GNSS_BACK)

    assert lost(every=500) == []
    assert len(lost(every=20)) == 1
    flight.run(6.0)
    assert flight.told(AlertId.GNSS_BACK)


# --- what is answered, and what runs over ---------------------------------------------------------


def silent(flight: Flight, turn: int) -> None:
    """What is nothing to us: times, parameters, serial ports, files."""
    epochs = (0, 1, 1_790_000_000_000_000, 2**64 - 1)
    flight.say(mavlink.MAVLink_system_time_message(epochs[turn % 4], turn * 7919 % 2**32))
    flight.say(mavlink.MAVLink_serial_control_message(10, 255, 65535, 115200, 70, [255] * 70))
    flight.say(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 191, [turn % 256] * 251))
    flight.say(mavlink.MAVLink_param_value_message(b"X%d" % turn, math.nan, 9, 65535, turn))


def missions(flight: Flight, turn: int) -> None:
    """Half an upload, again and again."""
    flight.end.mission.wanted = True
    to = (1, flight.shared.config.companion_component)
    flight.say(mavlink.MAVLink_mission_count_message(*to, (3, 65535, 0)[turn % 3]))
    flight.say(
        mavlink.MAVLink_mission_item_int_message(
            *to, turn % 2, 0, 16, 0, 0, math.nan, 0, 0, 0, *PLACE, math.inf
        )
    )


def questions(flight: Flight, turn: int) -> None:
    flight.link.congested = True
    flight.say(mavlink.MAVLink_timesync_message(0, turn))


@pytest.mark.parametrize("attack", [silent, missions, questions])
def test_what_asks_for_an_answer_without_end_gets_few(flight: Flight, attack: Attack) -> None:
    before = len(flight.link.sent)
    for turn in range(300):
        attack(flight, turn)
    assert len(flight.link.sent) - before <= 5
    assert flight.longest() <= 512


@pytest.mark.parametrize(
    "corners",
    [
        [math.nan] * 4,
        [-0.5, -0.5, 0.5, 0.5],
        [0.6, 0.6, 0.4, 0.4],
        [0.0] * 4,
        [math.inf, 0.0, 1.0, 1.0],
        [0.2, 0.2, 0.2, 0.8],
    ],
)
def test_no_rectangle_without_an_area_in_the_picture_is_tracked(flight, corners):
    for order in (
        mavlink.MAVLink_command_long_message(1, 100, 2005, 0, *corners, 0, 0, 0),
        mavlink.MAVLink_command_int_message(
            1, 100, 0, 2005, 0, 0, *corners, -(2**31), 2**31 - 1, math.nan
        ),
    ):
        flight.say(order, system=255, component=190)
        assert flight.link.sent[-1][1].result == mavlink.MAV_RESULT_DENIED
    assert not flight.tracked


def test_a_click_never_has_a_detected_targets_number() -> None:
    numbers, clicks = TargetNumbers(), clicked_numbers()
    detected = {numbers.number_of(f"car {n}") for n in range(1500)}
    assert detected.isdisjoint(next(clicks) for _ in range(3000))


def test_no_flood_of_clicks_ends_the_targets_that_are_followed(flight: Flight) -> None:
    for turn in range(200):
        x = 0.2 + 0.003 * turn
        click = mavlink.MAVLink_command_long_message(1, 100, 2004, 0, x, x, 0, 0, 0, 0, 0)
        flight.say(click, system=255, component=190)
        flight.run(0.01)
    assert len(flight.tracked) == 10
    busy = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert [m.result for _, m, _ in flight.link.sent if m.get_type() == "COMMAND_ACK"][-1] == busy
    flight.run(5.0)
    flight.say(click, system=255, component=190)
    assert len(flight.tracked) == 11


def test_a_line_repeated_at_once_is_told_once_and_on_after_off_is_told() -> None:
    told, now_ns = list[Alert](), [0]
    status = OperatorStatus(lambda *_: None, told.append, lambda: now_ns[0])
    refused = alert(AlertId.LOOK_AT_NO_TARGET, number=3)
    on, off = (alert(of, by="command") for of in (AlertId.INJECTION_ON, AlertId.INJECTION_OFF))
    for news in (*[refused] * 250, on, off, on, on):
        status.report(news)
        now_ns[0] += 10 * MS
    assert told == [refused, refused, refused, on, off, on]
