"""No switch to vision and no injection before vision was seen to agree with GNSS; what is told."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.catalogue import alert, cleared
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import ChosenSet, GnssProblem, Output
from mavlink_bridge.config import (
    BridgeConfig,
    InjectionConfig,
    InjectionEnableConfig,
    SourceSwitchConfig,
)
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.injection.shadow import ShadowInterlock, ShadowScore
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.status import StatusNotifier
from tests.mavlink_bridge.simulated import SECOND, Flight

SWITCH = SourceSwitchConfig(enabled=True)


def orders(flight: Flight) -> list[float]:
    sent = [m for _, m, _ in flight.link.sent if getattr(m, "command", 0) == 42007]
    return [m.param1 for m in sent]


SHADOW = (AlertId.INJECTION_FORCED, AlertId.INJECTION_NOT_READY, AlertId.INJECTION_UNCHECKED)
SOURCES = (AlertId.SOURCE_SET_UNKNOWN, AlertId.SOURCE_SET_SELECTED)
OFF = alert(AlertId.SHADOW_MEDIAN, metres=20.0)
RATE = alert(AlertId.SHADOW_RATE, hertz=3.0, needed=4.0)


def told(flight: Flight, *wanted: AlertId) -> list[AlertId]:
    return [a.id for a in flight.told(*wanted)]


def on_gnss(monkeypatch: pytest.MonkeyPatch, **options: Any) -> Flight:
    """A vehicle with a healthy receiver, at home."""
    flight = Flight(monkeypatch, **options)
    flight.gnss_north_m = 0.0
    flight.origin = (47.397742, 8.545594, 488.0)
    return flight


def test_a_map_20_m_off_is_neither_injected_nor_switched_to(monkeypatch):
    flight = on_gnss(monkeypatch, switch=SWITCH)
    flight.north_m = 20.0
    flight.run(45.0)
    assert flight.vision() == []
    assert orders(flight) == []
    refused = flight.told(AlertId.SOURCE_SET_HELD)
    assert 4 <= len(refused) <= 5  # again every 10 s
    assert {a.values[::2] for a in refused} == {("GNSS off vision", "EKF with GNSS")}
    assert told(flight, OFF.id) == [OFF.id]
    # Nor once GNSS is lost, however long ago: what was wrong stays wrong.
    flight.gnss_north_m = None
    flight.run(150.0)
    assert flight.vision() == []
    assert orders(flight) == []
    lost = flight.told(AlertId.GNSS_LOST)
    assert lost == [alert(AlertId.GNSS_LOST, output=Output.NOTHING)]


def test_a_map_20_m_off_is_as_wrong_after_a_restart_under_denial(monkeypatch, tmp_path):
    """The process that had seen it was killed, the next one had nothing to compare with: after two
    seconds it injected. Another map is not blamed.
    """
    enable, file = tmp_path / "gate.json", tmp_path / "shadow-no-go.json"

    def begun(map_id: str) -> Flight:
        flight = on_gnss(monkeypatch, state_file=enable)
        flight.end.interlock.set_map_id(map_id)
        flight.end.interlock.recall()
        return flight

    killed = begun("map a")
    killed.north_m = 20.0
    killed.run(15.0)
    assert killed.vision() == []
    while not file.exists():  # written by its own thread
        pass
    other = begun("map b")
    other.gnss_north_m = None
    other.run(10.0)
    assert other.vision()
    other.end.interlock.end(clean_shutdown=False)
    again = begun("map a")
    again.north_m, again.gnss_north_m = 20.0, None
    again.run(30.0)
    assert again.vision() == []
    assert set(told(again, AlertId.SHADOW_RESTORED, OFF.id)) == {AlertId.SHADOW_RESTORED}
    # It is mended: GNSS comes back and agrees.
    again.gnss_north_m = again.north_m = 0.0
    again.run(150.0)
    assert again.vision()
    while file.exists():
        pass
    for flight in (killed, again):
        flight.end.interlock.end()
    assert not file.exists()


def test_who_has_begun_is_not_kept_from_beginning_by_a_restart(monkeypatch, tmp_path):
    """A receiver that is led astray while vision is flown on speaks against it, too: without the
    restart it is flown on.
    """
    flight = on_gnss(monkeypatch, state_file=tmp_path / "gate.json")
    flight.run(12.0)
    flight.gnss_north_m = flight.ekf_north_m = 20.0
    flight.run(30.0)
    assert flight.end.shadow_score(flight.now_ns).against
    flight.end.interlock.end(clean_shutdown=False)  # what is stored is on the disk then
    assert not (tmp_path / "shadow-no-go.json").exists()


def test_a_port_that_takes_nothing_is_no_vision_to_switch_to(monkeypatch):
    """The EKF would be left to positions that never reach it. Half a second is no news."""
    flight = on_gnss(monkeypatch, switch=SWITCH)
    flight.run(20.0)
    for _ in range(5):
        flight.link.full = True
        flight.run(0.5)
        assert flight.end.sender.is_good(flight.now_ns)
        flight.link.full = False
        flight.run(2.0)
    assert told(flight, AlertId.LINK_FULL) == []
    assert flight.end.sender.reaches_ekf(flight.now_ns)
    flight.link.full = True
    flight.run(3.0)
    assert not flight.end.sender.is_good(flight.now_ns)
    assert told(flight, AlertId.LINK_FULL) == [AlertId.LINK_FULL]
    assert flight.end.injection_fault == alert(AlertId.LINK_FULL)
    assert not flight.end.sender.reaches_ekf(flight.now_ns)
    flight.gnss_north_m = None
    flight.run(6.0)
    assert told(flight, *SOURCES) == []
    flight.link.full = False
    flight.run(4.0)
    assert told(flight, *SOURCES) == [AlertId.SOURCE_SET_SELECTED]
    assert flight.end.injection_fault is None


def test_a_spoofed_receiver_that_the_ekf_refuses_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = on_gnss(monkeypatch, switch=SWITCH)
    flight.run(20.0)
    flight.gnss_north_m = 40.0  # the EKF, inertial, stays
    flight.run(4.0)
    assert set(orders(flight)) == {2.0}
    assert told(flight, *SOURCES, AlertId.SOURCE_SET_HELD) == [AlertId.SOURCE_SET_SELECTED]


def test_a_receiver_that_misses_a_second_is_no_flight_without_gnss(monkeypatch):
    """Injection would begin unproven, and would not be taken back."""
    flight = on_gnss(monkeypatch)
    for _ in range(3):  # too short for a score, and a gap of 1.8 s: lost for 0.3 s
        flight.gnss_north_m = 0.0
        flight.run(1.0)
        flight.gnss_north_m = None
        flight.run(1.8)
    flight.gnss_north_m = 0.0
    flight.run(1.0)
    assert flight.vision() == []
    assert told(flight, *SHADOW) == []


def test_a_rate_that_was_low_on_gnss_does_not_forbid_for_ever(monkeypatch):
    """It says nothing against the map: a vehicle without GNSS would have landed for it."""
    flight = on_gnss(monkeypatch)
    for _ in range(80):
        for flight.sees, seconds in ((True, 0.1), (False, 0.3)):
            flight.run(seconds)
    assert flight.vision() == []
    assert told(flight, AlertId.SHADOW_RATE, AlertId.SHADOW_FEW_FIXES)
    flight.sees, flight.gnss_north_m = True, None
    flight.run(6.0)
    assert len(flight.vision()) > 20
    assert told(flight, *SHADOW) == [AlertId.INJECTION_UNCHECKED]


def chosen(flight: Flight, source_set: int) -> None:
    """Somebody else than the bridge selects a set: what ArduPilot says then."""
    text = f"Using EKF Source Set {source_set}".encode()
    flight.say(mavlink.MAVLink_statustext_message(6, text))


def accept(flight: Flight, *, echo: bool) -> None:
    """The vehicle carries out the order, and acknowledges it."""
    if echo:
        chosen(flight, int(orders(flight)[-1]))
    flight.say(mavlink.MAVLink_command_ack_message(42007, 0))


def test_an_ekf_that_flies_on_vision_since_before_the_start_is_no_word_for_vision(monkeypatch):
    """A companion that begins anew in the air: a wrong map was compared with itself, and a go."""
    flight = on_gnss(monkeypatch, switch=SWITCH)
    flight.armed = True
    flight.north_m = flight.ekf_north_m = 20.0  # it follows the wrong map
    flight.run(20.0)
    assert flight.vision() == []
    assert told(flight, *SOURCES) == list(SOURCES)  # injection has not begun
    assert flight.told(*SOURCES)[1].values[0] == 1
    assert told(flight, OFF.id) == [OFF.id]


def test_a_start_in_the_air_on_gnss_is_compared_with_the_receiver_and_switches(monkeypatch):
    flight = on_gnss(monkeypatch, switch=SWITCH)
    flight.armed = True
    flight.run(20.0)
    assert flight.vision()
    assert not flight.end.sources.on_gnss  # the order of the set of GNSS was not acknowledged
    assert set(orders(flight)) == {1.0}
    flight.gnss_north_m = None
    flight.run(6.0)
    assert orders(flight)[-1] == 2.0
    accept(flight, echo=True)
    assert flight.end.sources.current == 2


def test_a_start_in_the_air_on_vision_goes_back_to_gnss_where_vision_ends(monkeypatch):
    """The EKF had no position at all then, and the vehicle landed."""
    flight = on_gnss(monkeypatch, switch=SWITCH)
    flight.armed, flight.sees = True, False
    flight.run(7.0)
    assert set(orders(flight)) == {1.0}
    accept(flight, echo=True)
    assert flight.end.sources.on_gnss


def test_shadow_mode_orders_nothing_in_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = on_gnss(monkeypatch, switch=SWITCH, mode="shadow")
    flight.run(3.0)
    assert flight.end.sender.is_good(flight.now_ns)
    assert not flight.end.sender.reaches_ekf(flight.now_ns)
    flight.armed, flight.sees = True, False
    flight.run(7.0)
    assert orders(flight) == []


@pytest.mark.parametrize("echo", [True, False])
def test_what_the_pilot_chooses_is_followed_and_not_undone(monkeypatch, echo):
    switch = SourceSwitchConfig(enabled=True, return_to_gnss=True)
    flight = on_gnss(monkeypatch, switch=switch)
    flight.run(20.0)
    chosen(flight, 2)  # before a denial that is meant
    compared_ns = flight.end.outcome.compared_ns
    flight.run(10.0)
    assert not flight.end.sources.on_gnss
    assert flight.end.outcome.compared_ns == compared_ns
    assert orders(flight) == []
    chosen(flight, 1)
    flight.run(10.0)
    assert flight.end.sources.on_gnss
    # A choice is no word on what comes later.
    flight.gnss_north_m = None
    flight.run(4.0)
    accept(flight, echo=echo)
    assert set(orders(flight)) == {2.0}
    # He does not trust vision: back, against what the bridge takes for a fault.
    chosen(flight, 1)
    begun = len(orders(flight))
    flight.run(8.0)
    assert len(orders(flight)) == begun
    assert [a.values for a in flight.told(AlertId.SOURCE_SET_HELD)] == [
        (GnssProblem.LOST, 0.0, ChosenSet(1))
    ]
    # Once GNSS was well again, the next fault is another one.
    flight.gnss_north_m = 0.0
    flight.run(4.0)
    flight.gnss_north_m = None
    flight.run(4.0)
    assert orders(flight)[begun:]


def test_a_receiver_that_returns_wrong_is_refused_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the echo of our own order is nobody's choice: it goes back once the receiver is right."""
    flight = on_gnss(monkeypatch, switch=SourceSwitchConfig(enabled=True, return_to_gnss=True))
    flight.run(20.0)
    flight.gnss_north_m = None
    flight.run(4.0)
    accept(flight, echo=True)
    chosen(flight, 2)  # heard twice, the second time after the acknowledgement
    flight.gnss_north_m = 300.0
    flight.run(15.0)
    assert set(orders(flight)) == {2.0}
    refused = flight.told(AlertId.GNSS_REFUSED)
    assert len(refused) == 2  # again after 10 s
    assert refused[0].values[1] == "m off vision"
    assert told(flight, AlertId.GNSS_BACK) == []
    flight.gnss_north_m = 0.0
    flight.run(9.0)
    assert orders(flight)[-1] == 1.0
    assert flight.told(AlertId.GNSS_REFUSED)[2:] == [cleared(AlertId.GNSS_REFUSED)]


def test_force_overrules_and_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    injection = InjectionConfig(rate_hz=10, delay_ms=100, force=True)
    flight = on_gnss(monkeypatch, injection=injection)
    flight.north_m = 20.0
    flight.run(15.0)
    assert len(flight.vision()) > 50
    assert told(flight, *SHADOW) == [AlertId.INJECTION_FORCED]


def test_what_is_forbidden_does_not_begin_and_goes_on_where_it_flies(monkeypatch):
    """A calibration that was found wrong: no injection, no switch, until it is over."""
    flight = on_gnss(monkeypatch, switch=SWITCH)
    flight.end.inhibit(AlertId.FOCAL_LENGTH)
    flight.run(18.0)
    assert flight.vision() == []
    assert flight.told(AlertId.INHIBITED) == [alert(AlertId.INHIBITED, alert=AlertId.FOCAL_LENGTH)]
    flight.gnss_north_m = None
    flight.run(5.0)
    assert flight.vision() == []
    assert orders(flight) == []
    flight.gnss_north_m = 0.0
    flight.end.clear(AlertId.FOCAL_LENGTH)
    flight.run(3.0)
    assert flight.vision()
    begun_ns = flight.now_ns
    flight.end.inhibit(AlertId.FOCAL_LENGTH)
    flight.run(2.0)
    assert flight.vision(begun_ns)  # taking it back would leave the vehicle without a position


def test_what_gps_input_told_the_receiver_is_no_word_for_vision(monkeypatch):
    """The pilot had injected a map 20 m off: receiver and EKF repeated it, which was a go, and his
    next injection and a switch to vision began without a word.
    """
    enable = InjectionEnable(InjectionEnableConfig(), lambda _: None)
    injection = InjectionConfig(rate_hz=10, delay_ms=100, message="gps_input")
    flight = on_gnss(monkeypatch, enable=enable, mode="rc", injection=injection, switch=SWITCH)
    flight.north_m = 20.0
    flight.run(10.0)
    enable.command(31010, 1.0)
    flight.run(1.0)
    flight.gnss_north_m = flight.ekf_north_m = 20.0
    flight.run(150.0)
    score = flight.end.shadow_score(flight.now_ns)
    assert not score.ready, score.line()
    assert flight.end.on_gnss(flight.now_ns) is False
    enable.command(31010, 0.0)
    flight.run(1.0)
    enable.command(31010, 1.0)
    flight.run(1.0)
    assert told(flight, *SHADOW) == 2 * [AlertId.INJECTION_NOT_READY]


@pytest.mark.parametrize(
    ("autopilot", "depends"),
    [(mavlink.MAV_AUTOPILOT_PX4, True), (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, False)],
)
def test_px4_fuses_vision_beside_gnss_so_its_position_is_no_evidence(
    monkeypatch, autopilot, depends
):
    """It has no source sets: the bridge took its position for GNSS while vision moved it."""
    flight = on_gnss(monkeypatch, injection=InjectionConfig(rate_hz=10, delay_ms=100, force=True))
    flight.autopilot = autopilot
    flight.run(5.0)
    assert flight.vision()
    assert flight.end.on_gnss(flight.now_ns) is not depends


def test_gps_input_in_shadow_is_compared_with_the_receiver_that_is_there(monkeypatch):
    injection = InjectionConfig(rate_hz=10, delay_ms=100, message="gps_input", gps_id=1)
    flight = on_gnss(monkeypatch, mode="shadow", injection=injection)
    flight.run(20.0)
    assert flight.end.shadow_score(flight.now_ns).ready
    assert flight.end.on_gnss(flight.now_ns)


class Compared:
    """An interlock whose score and comparisons are said."""

    def __init__(self) -> None:
        self._go, self._compared_ns = False, 0
        self._interlock = ShadowInterlock(
            BridgeConfig(),
            lambda _: ShadowScore(self._go, 100, () if self._go else (RATE,)),
            lambda: self._compared_ns,
            StatusNotifier(lambda _: None),
        )

    def may_switch(self, second: int, *, go: bool, gnss: bool = True) -> bool:
        now_ns = second * SECOND
        self._go, self._compared_ns = go, now_ns if gnss else self._compared_ns
        state = VehicleState(connected=True, gps_fix_type=3, gps_time_ns=now_ns if gnss else 1)
        self._interlock.mode("shadow", state, now_ns, by_pilot=False)
        return self._interlock.may_switch(now_ns)


@pytest.mark.parametrize(("gnss", "counts_until_s"), [(True, 130), (False, 700)])
def test_a_go_is_forgotten(gnss: bool, counts_until_s: int) -> None:
    """After half a minute of comparisons that are none, and ten minutes without GNSS: a receiver
    that is jammed slowly spoils the score's end, and no more than its end.
    """
    compared = Compared()
    assert compared.may_switch(100, go=True)
    assert compared.may_switch(counts_until_s - 1, go=False, gnss=gnss)
    assert not compared.may_switch(counts_until_s + 1, go=False, gnss=gnss)


@pytest.mark.parametrize(("gnss", "text"), [(None, ["injecting"]), (0.0, [])])
def test_without_gnss_it_begins_and_says_that_nothing_was_compared(monkeypatch, gnss, text):
    """A restart under denial. When it is armed it is told whether positions flow."""
    flight = on_gnss(monkeypatch)
    flight.gnss_north_m, begun_ns = gnss, flight.now_ns
    flight.run(10.0)
    flight.armed = True
    flight.run(5.0)
    assert [a.values[0] for a in flight.told(AlertId.ARMED_WITHOUT_GNSS)] == text
    assert told(flight, *SHADOW) == ([AlertId.INJECTION_UNCHECKED] if gnss is None else [])
    if gnss is None:
        assert flight.vision()[0][0] - begun_ns < 5 * SECOND


@pytest.mark.parametrize("gnss", [0.0, None])
def test_a_vehicle_met_in_flight_is_judged_with_its_first_gnss_report(monkeypatch, gnss):
    """Its heartbeat may come before GPS_RAW_INT: good GNSS was told to be missing."""
    flight = on_gnss(monkeypatch)
    flight.gnss_north_m, flight.armed = None, True
    flight.run(1.5)
    flight.gnss_north_m = gnss
    flight.run(5.0)
    told = [] if gnss is not None else ["injecting"]
    assert [a.values[0] for a in flight.told(AlertId.ARMED_WITHOUT_GNSS)] == told


def test_a_flight_by_the_book_in_texts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each event once, in its order, and nothing else."""
    flight = on_gnss(monkeypatch, switch=SWITCH)
    begun_ns = flight.now_ns
    flight.run(2.0)
    flight.armed = True
    flight.run(28.0)  # shadow, go, injecting
    assert 5 * SECOND < flight.vision()[0][0] - begun_ns < 10 * SECOND
    flight.gnss_north_m = None
    flight.run(1.0)
    flight.gnss_north_m = 0.0  # a second without a report is none
    flight.run(10.0)
    assert orders(flight) == []
    flight.gnss_north_m = None
    flight.run(20.0)
    assert set(orders(flight)) == {2.0}
    for gap_s in (0.8, 5.0):  # a few fixes that are dropped are no news
        flight.sees = False
        flight.run(gap_s)
        flight.sees = True
        flight.run(2.0)
    flight.run(18.0)
    flight.gnss_north_m = 0.0
    flight.run(8.0)
    assert [a.id for a in flight.alerts] == [
        AlertId.FC_FOUND,
        AlertId.ORIGIN_KNOWN,
        AlertId.INJECTING,
        AlertId.EKF_FOLLOWS,
        AlertId.GNSS_LOST,
        AlertId.SOURCE_SET_SELECTED,
        AlertId.NO_FRESH_FIX,
        AlertId.INJECTING,
        AlertId.GNSS_BACK,
    ]


def test_an_overloaded_computer_does_not_fill_the_operators_screen(monkeypatch):
    """A second and a half of fixes, as long without, for three minutes: 42 texts before."""
    flight = Flight(monkeypatch)
    flight.run(20.0)
    before = len(flight.alerts)
    for _ in range(60):
        flight.sees = False
        flight.run(1.6)
        flight.sees = True
        flight.run(1.9)
    counts = Counter(a.id for a in flight.alerts[before:])
    assert max(counts.values()) <= 6, counts
    assert sum(counts.values()) <= 12, counts
    flight.run(70.0)
    # And it is told that it is over.
    assert flight.alerts[-1].id in (AlertId.INJECTING, AlertId.EKF_FOLLOWS)
