"""The EKF's answer, clocks, and a monitor that fails: each told, and none of them by accident."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from companion.integrity_monitor.checks import IntegrityChecks, IntegrityLimits
from companion.integrity_monitor.config import IntegrityMonitorConfig
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, cleared
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import Attitude, InertialSample, VehicleState, VisionFix
from tests.companion.integrity_monitor.simulated import Flight, Path, hover, leg, monitor, second

PICTURE = np.random.default_rng(3).integers(0, 255, (120, 160, 3)).astype(np.uint8)


class Answering(Flight):
    """The EKF's innovation ratio and a leap of its position, by the time."""

    ratio: Any = staticmethod(lambda at_s: 0.2)
    leap_m: Any = staticmethod(lambda at_s: 0.0)

    def state(self) -> VehicleState:
        state = super().state()
        north, east, down = state.local_position_ned or (0.0, 0.0, 0.0)
        return replace(
            state,
            ekf_horizontal_variance=self.ratio(self.at_s),
            local_position_ned=(north + self.leap_m(self.at_s), east, down),
        )


def flown(path: Any, seconds: float, **answers: Any) -> Answering:
    flight = Answering(monitor(), path, noise_m=0.05)
    for name, answer in answers.items():
        setattr(flight, name, answer)
    flight.fly(seconds)
    return flight


def test_an_ekf_that_refuses_is_told_again_as_long_as_it_does() -> None:
    flight = flown(hover, 30.0, ratio=lambda at_s: 1.4 if 5.0 <= at_s < 20.0 else 0.3)
    told = flight.times(AlertId.EKF_REJECTS_VISION)
    assert {one.values for _, one in flight.lines if one.active} == {(1.4,)}
    assert told[0] == pytest.approx(7.0, abs=0.3)
    assert np.diff(told) == pytest.approx([10.0], abs=0.3)
    assert 23.0 <= flight.ended(AlertId.EKF_REJECTS_VISION) < 23.5
    assert flight.held == []  # what it refuses does no harm; silence would


@pytest.mark.parametrize(
    ("path", "answers"),
    [
        (hover, {"ratio": lambda _: None}),
        (hover, {"ratio": lambda _: float("inf")}),
        (hover, {"ratio": lambda at_s: 1.5 if 5.0 <= at_s < 6.5 else 0.3}),  # a gust, a turn
        # Out of a hover with 2.5 m/s^2, and a metre of an EKF's own correction.
        (leg, {"leap_m": lambda at_s: 1.0 if at_s >= 8.0 else 0.0}),
    ],
)
def test_what_is_neither_a_refusal_nor_a_jump_is_not_told(path: Path, answers: Any) -> None:
    assert flown(path, 12.0, **answers).lines == []


def test_a_reset_of_the_ekf_is_unconfirmed_until_the_imu_has_agreed_for_a_while() -> None:
    """Meanwhile nobody says that the EKF follows."""
    flight = flown(leg, 14.0, leap_m=lambda at_s: 15.0 if at_s >= 12.0 else 0.0)
    assert flight.monitor.inhibiting == {AlertId.EKF_JUMP}
    flight.fly(30.0)
    assert flight.lines[0][1].id is AlertId.EKF_JUMP
    assert list(flight.lines[0][1].values) == [pytest.approx(15.0, abs=0.5)]
    assert flight.lines[0][0] == pytest.approx(12.0, abs=0.15)
    assert 21.5 <= flight.ended(AlertId.EKF_JUMP) <= 24.0


@dataclass
class Waiting(Answering):
    """On the ground until 20 s, then off to 10 m/s."""

    def state(self) -> VehicleState:
        return replace(super().state(), armed=self.at_s >= 20.0)


def departs(at_s: float) -> tuple[float, float]:
    return leg(at_s - 20.0) if at_s >= 20.0 else leg(0.0)


@pytest.mark.parametrize(("leaps_s", "until_s", "told"), [(8.0, 30.0, False), (20.5, 22.0, True)])
def test_an_ekf_that_begins_before_arming_is_no_jump_and_one_that_leaps_after_it_is(
    leaps_s: float, until_s: float, told: bool
) -> None:
    """From its origin onto the first position 300 m away: told at the moment of arming, and "the
    EKF follows" was not said for the first ten seconds of flight.
    """
    flight = Waiting(monitor(), departs, noise_m=0.05)
    flight.leap_m = lambda at_s: 300.0 if at_s >= leaps_s else 0.0
    flight.fly(until_s)
    jump = alert(AlertId.EKF_JUMP, metres=pytest.approx(300.0, abs=0.5))
    assert [one for _, one in flight.lines] == ([jump] if told else [])
    assert flight.monitor.inhibiting == ({AlertId.EKF_JUMP} if told else set())


@pytest.mark.parametrize("stamp", [lambda _: 5.0, lambda at_s: 20.0 - at_s])
def test_pictures_whose_clock_stands_or_runs_back_are_withheld(stamp: Any) -> None:
    """From 5 s on; the fixes go on under stamps of their own."""
    watched = monitor()
    flight = Flight(watched, noise_m=0.05)
    told_s = np.inf
    for tenth in range(1, 100):
        flight.fly(0.1 * tenth)
        at_s = 0.1 * tenth
        moved = np.roll(PICTURE, 7 * tenth, axis=1)
        watched.add_frame(second(at_s if at_s < 5.0 else stamp(at_s)), moved)
        told_s = min(told_s, flight.told(AlertId.VIDEO_TIMESTAMPS))
    assert 5.5 <= told_s < 6.5
    assert max(flight.held) > 9.7
    assert not [at_s for at_s in flight.held if at_s < 5.5]


def test_pictures_that_come_twice_now_and_then_are_no_broken_clock() -> None:
    watched = monitor()
    flight = Flight(watched, noise_m=0.05)
    for tenth in range(1, 60):
        flight.fly(0.1 * tenth)
        watched.add_frame(second(0.1 * tenth), PICTURE)
        watched.add_frame(second(0.1 * tenth), PICTURE)  # as a feed repeats a frame
    assert not flight.times(AlertId.VIDEO_TIMESTAMPS)


FAILED = alert(AlertId.MONITOR_FAILED)


class Faulty:
    """A bridge that fails where the monitor asks it, while it is told to."""

    def __init__(self, flight: Flight) -> None:
        self.flight = flight
        self.fails_at: set[str] = set()
        self.said: list[Alert] = []

    def state(self) -> VehicleState:
        if "state" in self.fails_at:
            raise RuntimeError("boom")
        return self.flight.state()

    def inertial_since(self, time_ns: int) -> tuple[InertialSample, ...]:
        if "inertial_since" in self.fails_at:
            raise RuntimeError("bang")
        return ()

    def attitude_at(self, time_ns: int) -> Attitude | None:
        return None

    def report_alert(self, alert: Alert) -> None:
        self.said.append(alert)

    def inhibit(self, of: AlertId) -> None:
        pass

    def clear(self, of: AlertId) -> None:
        pass


def watching(clock: Callable[[], int]) -> tuple[IntegrityMonitor, Any]:
    """A monitor by this clock, and its bridge."""
    bridge: Any = Faulty(Flight(monitor()))
    config, limits = IntegrityMonitorConfig(), IntegrityLimits()
    return IntegrityMonitor(config, limits, bridge, clock=clock), bridge


@pytest.fixture
def faulty() -> tuple[IntegrityMonitor, Any]:
    """Its clock goes on by the monitor's period at each turn."""
    times = iter(range(second(10.0), second(100.0), second(0.1)))
    return watching(lambda: next(times))


FIX = VisionFix(second(1.0), 47.0, 8.0, 500.0)


def test_a_fix_that_cannot_be_judged_is_withheld_told_and_costs_itself_only(faulty, caplog):
    """It passed unjudged: whatever position fails the monitor would have been believed."""
    integrity_monitor, bridge = faulty
    bridge.fails_at = {"state"}
    assert integrity_monitor.check(FIX) is None
    assert "boom" in caplog.text
    bridge.fails_at = set()
    assert integrity_monitor.check(FIX) is not None
    integrity_monitor.run_checks()
    assert bridge.said == []  # one of many
    bridge.fails_at = {"state"}
    assert integrity_monitor.check(FIX) is None
    integrity_monitor.run_checks()
    assert bridge.said == [FAILED]
    assert integrity_monitor.reason == FAILED
    bridge.fails_at = set()
    assert integrity_monitor.check(FIX) is not None
    for _ in range(30):
        integrity_monitor.run_checks()
    assert bridge.said[1:] == [cleared(AlertId.MONITOR_FAILED)]
    assert integrity_monitor.reason is None


def test_a_guardian_that_sees_nothing_for_a_second_withholds_until_it_does(faulty):
    """Fixes can be judged, but nobody watches the pictures, the IMU, the EKF."""
    integrity_monitor, bridge = faulty
    bridge.fails_at = {"inertial_since"}
    integrity_monitor.run_checks()
    assert integrity_monitor.check(FIX) is not None
    for _ in range(9):
        integrity_monitor.run_checks()
    assert integrity_monitor.check(FIX) is None
    assert FAILED in bridge.said
    bridge.fails_at = set()
    integrity_monitor.run_checks()
    assert integrity_monitor.check(FIX) is not None


def test_a_guardian_that_fails_at_each_picture_of_a_slow_video_withholds(faulty, monkeypatch):
    """At 5 pictures a second every other turn had none, and was well: fixes passed under the text
    that they were withheld, and no picture was ever looked at.
    """
    integrity_monitor, bridge = faulty

    def fails(*_: object) -> None:
        raise ValueError("no picture")

    with monkeypatch.context() as broken:
        broken.setattr(IntegrityChecks, "add_frame", fails)
        for turn in range(20):
            if turn % 2:
                integrity_monitor.add_frame(second(10.0 + turn), PICTURE)
            integrity_monitor.run_checks()
        assert integrity_monitor.check(FIX) is None
        assert bridge.said == [FAILED]
    integrity_monitor.run_checks()
    assert integrity_monitor.check(FIX) is None  # without a picture it saw nothing
    integrity_monitor.add_frame(second(40.0), PICTURE)
    integrity_monitor.run_checks()
    assert integrity_monitor.check(FIX) is not None


def test_a_picture_that_fails_now_and_then_withholds_nothing(faulty, monkeypatch):
    integrity_monitor, _ = faulty
    see = IntegrityChecks.add_frame

    def fails(watched: IntegrityChecks, time_ns: int, image: Any) -> None:
        if time_ns % second(4.0) == 0:
            raise ValueError("no picture")
        see(watched, time_ns, image)

    monkeypatch.setattr(IntegrityChecks, "add_frame", fails)
    for turn in range(60):
        integrity_monitor.add_frame(second(10.0 + turn), np.roll(PICTURE, 7 * turn, axis=1))
        integrity_monitor.run_checks()
        assert integrity_monitor.check(replace(FIX, time_ns=second(1.0) + turn)) is not None


def test_a_reset_that_falls_into_a_blind_time_is_announced_after_it(faulty):
    """A jumped place proved itself while nobody watched: the EKF would have fought it, untold."""
    integrity_monitor, bridge = faulty
    before = integrity_monitor.check(FIX)
    jumped = [replace(FIX, time_ns=second(1.0 + k), latitude_deg=47.01) for k in range(1, 9)]
    assert [integrity_monitor.check(fix) for fix in jumped[:3]] == [None, None, None]
    bridge.fails_at = {"inertial_since"}
    for _ in range(10):
        integrity_monitor.run_checks()
    assert [integrity_monitor.check(fix) for fix in jumped[3:7]] == [None, None, None, None]
    bridge.fails_at = set()
    integrity_monitor.run_checks()
    passed = integrity_monitor.check(jumped[7])
    assert passed.reset_count != before.reset_count


class Hand:
    """A clock that goes on when it is told to."""

    def __init__(self) -> None:
        self.now_ns = second(10.0)

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def clock() -> Hand:
    return Hand()


def test_a_guardian_whose_thread_is_gone_withholds_and_whoever_asks_tells(clock: Hand) -> None:
    """Its last findings stood for ever: fixes passed, and neither health nor a text said a word."""
    integrity_monitor, bridge = watching(clock)
    integrity_monitor.run_checks()
    clock.now_ns += second(1.9)  # a busy computer
    assert integrity_monitor.check(FIX) is not None
    clock.now_ns += second(0.2)
    assert integrity_monitor.check(FIX) is None
    assert bridge.said == [FAILED]
    assert integrity_monitor.reason == FAILED
    assert (integrity_monitor.level, integrity_monitor.active_values()) == (None, {})
    clock.now_ns += second(10.0)
    integrity_monitor.check(FIX)
    assert len(bridge.said) == 2
    integrity_monitor.run_checks()  # it was only asleep
    assert integrity_monitor.check(FIX) is not None
    clock.now_ns += second(1.5)
    integrity_monitor.run_checks()
    clock.now_ns += second(1.6)
    integrity_monitor.run_checks()
    assert bridge.said[2:] == [cleared(AlertId.MONITOR_FAILED)]


def test_a_guardian_that_hangs_under_its_lock_hangs_nobody_else(clock: Hand) -> None:
    """The localization thread waited for it for ever, and the health behind it."""
    stuck, on = threading.Event(), threading.Event()
    integrity_monitor, bridge = watching(clock)

    def hangs(time_ns: int) -> tuple[InertialSample, ...]:
        stuck.set()
        on.wait()
        return ()

    bridge.inertial_since = hangs
    integrity_monitor.start()
    try:
        assert stuck.wait(30.0)
        assert integrity_monitor.reason == FAILED  # no fix passes, so none is kept for a restart
        clock.now_ns += second(2.5)
        assert integrity_monitor.check(FIX) is None
        assert integrity_monitor.reason == FAILED
        assert bridge.said == [FAILED]
    finally:
        on.set()
        integrity_monitor.stop()


def test_a_health_monitor_that_stands_is_told_again_as_long_as_it_does(clock: Hand) -> None:
    """Its last level went out with every heartbeat, for ever."""
    integrity_monitor, bridge = watching(clock)
    turned_ns = clock.now_ns
    integrity_monitor.watch(lambda: {"health": turned_ns})
    for _ in range(39):
        integrity_monitor.run_checks()
        clock.now_ns += second(0.1)
    assert bridge.said == []
    for _ in range(112):
        clock.now_ns += second(0.1)
        integrity_monitor.run_checks()
    assert bridge.said == [
        alert(AlertId.COMPONENT_STALLED, seconds=pytest.approx(s, abs=0.11), component="health")
        for s in (4.0, 14.0)
    ]  # fmt: skip
    integrity_monitor.watch(lambda: {"health": clock.now_ns})
    for _ in range(32):
        clock.now_ns += second(0.1)
        integrity_monitor.run_checks()
    assert bridge.said[2:] == [cleared(AlertId.COMPONENT_STALLED)]
