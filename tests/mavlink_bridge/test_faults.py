"""Links that break, clocks that step, controllers that reboot, frames that are damaged."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import TargetReport
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, cleared
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.components import GroundEnd
from mavlink_bridge.config import InjectionConfig, InjectionEnableConfig, SourceSwitchConfig
from mavlink_bridge.flight_controller import FC_WANTED
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.link.framing import FrameReader
from tests.mavlink_bridge.simulated import (
    HOME,
    MS,
    SECOND,
    Flight,
    SimulatedLink,
    frame_of,
    lengths,
)

LATE = (AlertId.FIXES_LATE, AlertId.FIXES_OVER_LIMIT)


@pytest.fixture
def flight(monkeypatch: pytest.MonkeyPatch) -> Flight:
    it = Flight(monkeypatch)
    it.run(15.0)
    assert len(it.vision()) > 50
    return it


def test_two_minutes_without_a_link(flight: Flight) -> None:
    """The localizer jumps meanwhile: the first message after it carries the jump and says so."""
    before = flight.vision()[-1][1]
    assert before.reset_counter == 0
    flight.link.open = False
    flight.run(40.0)
    flight.north_m, flight.ekf_north_m, flight.reset_count = 25.0, 25.0, 1
    flight.run(80.0)
    lost_ns = flight.now_ns
    assert flight.longest() <= 512
    flight.link.open = True
    flight.run(10.0)
    after = flight.vision(lost_ns)
    assert after[0][0] - lost_ns < 3 * SECOND
    assert after[0][1].reset_counter == 1
    assert after[0][1].x == pytest.approx(25.0, abs=0.3)
    assert {m.reset_counter for _, m in after} == {1}
    lost, back = AlertId.FC_LOST, AlertId.FC_BACK
    assert flight.told(lost, back) == [alert(lost), alert(back)]
    assert flight.end.counters["reboots"] == 0
    # Only what is fresh: nothing that waited during the loss.
    assert all(t - m.usec * 1000 <= 251 * MS for t, m in after)
    assert flight.longest() <= 512
    flight.reboot()
    flight.run(10.0)
    assert not flight.told(AlertId.TIMESYNC_UNANSWERED)  # a link that was gone owes no answers


def test_reboot_and_another_origin_during_the_loss(flight: Flight) -> None:
    """Boot time is behind where it should be; a position relative to the old origin is 1 km off."""
    flight.link.open = False
    flight.run(60.0)
    flight.reboot()
    flight.run(200.0)  # its clock is ahead of what it last said
    flight.origin = (HOME[0] + 0.01, HOME[1], 480.0)
    lost_ns = flight.now_ns
    flight.link.open = True
    flight.run(10.0)
    after = flight.vision(lost_ns)
    assert after[0][0] - lost_ns < 4 * SECOND
    assert {round(m.x) for _, m in after} == {-1113}
    assert {round(m.z) for _, m in after} == {-508}
    assert flight.attitude_error() < 0.005


def test_reboot_in_flight(flight: Flight) -> None:
    flight.reboot()
    rebooted_ns = flight.now_ns
    flight.run(15.0)
    after = flight.vision(rebooted_ns + 300 * MS)
    assert after[0][0] - rebooted_ns < 10 * SECOND  # origin asked for, then set again
    assert len(after) > 40
    assert {m.reset_counter for _, m in after} == {0}
    assert flight.end.counters["reboots"] == 1
    assert len(flight.told(AlertId.FC_REBOOTED)) == 1
    assert flight.attitude_error() < 0.005


def test_a_clock_that_is_not_compared_any_more_is_told(flight: Flight) -> None:
    """Two crystals part by up to 0.2 ms a second: after ten minutes a fix is 1 m late."""
    flight.say(mavlink.MAVLink_timesync_message(0, 123456789))
    answer = flight.link.sent[-1][1]
    assert (answer.tc1, answer.ts1) == (flight.now_ns, 123456789)  # its own question
    flight.run(20.0)
    flight.answers_timesync = False
    flight.run(14.0)
    assert not flight.told(AlertId.TIMESYNC_UNANSWERED)
    flight.run(20.0)
    assert flight.told(AlertId.TIMESYNC_UNANSWERED) == [alert(AlertId.TIMESYNC_UNANSWERED)]
    flight.answers_timesync = True
    flight.run(3.0)
    assert flight.alerts[-1] == cleared(AlertId.TIMESYNC_UNANSWERED)


@pytest.mark.parametrize("step_s", [-0.4, 0.4, 7.0, -40.0])
def test_step_of_the_vehicles_clock(flight: Flight, step_s: float) -> None:
    """Up to 1 s back is a step, more is what a reboot looks like; both are followed."""
    flight.clock_error_ns = int(step_s * SECOND)
    stepped_ns = flight.now_ns
    flight.run(15.0)
    assert flight.attitude_error() < 0.005
    after = flight.vision(stepped_ns)
    assert len(after) > (100 if step_s > -1.0 else 60)
    assert {m.reset_counter for _, m in after} == {0}
    stamps = [m.usec for _, m in flight.vision()]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    assert flight.end.counters["reboots"] == (1 if step_s < -1.0 else 0)


def test_reset_counter_wraps_and_every_jump_is_a_change(flight: Flight) -> None:
    for i in range(300):
        flight.north_m, flight.reset_count = float(i % 7), i + 1
        flight.run(0.3)
    messages = [m for _, m in flight.vision()]
    counters = [m.reset_counter for m in messages]
    assert max(counters) == 255
    assert counters[-1] == 300 % 256
    jumps = [(a, b) for a, b in itertools.pairwise(messages) if abs(a.x - b.x) > 0.5]
    assert len(jumps) > 290
    assert all((a.reset_counter + 1) % 256 == b.reset_counter for a, b in jumps)


def test_fixes_older_than_the_autopilot_can_fuse_are_told_and_their_end_too(monkeypatch):
    flight = Flight(monkeypatch, injection=InjectionConfig(rate_hz=10, delay_ms=250))
    flight.latency_ms = 320
    flight.run(30.0)
    flight.latency_ms = 240  # below the limit, and not enough below it to say so
    flight.run(20.0)
    told = flight.told(*LATE, AlertId.FIXES_IN_TIME)
    assert told == [alert(AlertId.FIXES_OVER_LIMIT, age_ms=320.0, limit_ms=250.0)]
    flight.latency_ms = 150
    flight.run(20.0)
    assert flight.alerts[-1].id is AlertId.FIXES_IN_TIME


def test_a_latency_text_never_names_a_figure_within_its_limit(monkeypatch):
    """220 ms are told; a latency that wanders about both limits says nothing untrue."""
    flight = Flight(monkeypatch, injection=InjectionConfig(rate_hz=10, delay_ms=220))
    for latency_ms in (240, 215, 245, 215):  # above delay_ms + 10, then a little below it
        flight.latency_ms = latency_ms
        flight.run(10.0)
    told = flight.told(*LATE, AlertId.FIXES_IN_TIME)
    assert told == [alert(AlertId.FIXES_LATE, age_ms=240.0, limit_ms=220.0)]
    flight.latency_ms = 260
    flight.run(10.0)
    flight.latency_ms = 215
    flight.run(10.0)
    told = flight.told(*LATE, AlertId.FIXES_IN_TIME)
    assert told[1:] == [alert(AlertId.FIXES_OVER_LIMIT, age_ms=260.0, limit_ms=250.0)]


def test_a_latency_that_comes_and_goes_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A computer at its limit is late and in time by turns: three texts a minute say no more."""
    flight = Flight(monkeypatch, injection=InjectionConfig(rate_hz=10, delay_ms=100))
    for latency_ms in (120, 80, 120, 80, 120):
        flight.latency_ms = latency_ms
        flight.run(8.0)
    assert len(flight.told(*LATE)) == 1
    flight.latency_ms = 80
    flight.run(30.0)
    assert flight.alerts[-1].id is AlertId.FIXES_IN_TIME


@pytest.mark.parametrize(("delay_ms", "texts"), [(100, 0), (45, 1)])
def test_what_counts_is_the_least_lag(monkeypatch, delay_ms, texts):
    """ArduPilot takes the least lag for VISO_DELAY_MS: later fixes beside it cost no position."""
    flight = Flight(monkeypatch, injection=InjectionConfig(rate_hz=10, delay_ms=delay_ms))
    flight.run(5.0)
    for latency_ms in itertools.islice(itertools.cycle((70, 125, 140, 150)), 100):
        flight.latency_ms = latency_ms
        flight.run(0.1)
    assert len(flight.told(*LATE)) == texts


# --- damaged input --------------------------------------------------------------------------------


def damage(rng: random.Random, share: float) -> Callable[[bytes], bytes]:
    """Flips, truncates, doubles, delays, swaps and adds noise to a share of the frames."""
    old: list[bytes] = []

    def mangle(frame: bytes) -> bytes:
        old.append(frame)
        del old[:-400]
        if rng.random() > share:
            return frame
        at = rng.randrange(len(frame))
        return (
            frame[:at] + bytes([frame[at] ^ 1 << rng.randrange(8)]) + frame[at + 1 :],
            frame[:at],
            frame + frame,
            b"",
            rng.choice(old) + frame,  # a copy that comes up to half a minute late
            frame + rng.randbytes(rng.randrange(1, 100)),
            b"\xfd" * rng.randrange(1, 300) + frame,
        )[rng.randrange(7)]

    return mangle


def test_damaged_frames_on_the_flight_controllers_link(monkeypatch):
    flight = Flight(monkeypatch)
    flight.mangle = damage(random.Random(0), 0.3)
    flight.run(90.0)
    counters = flight.reader.counters
    assert counters.bad_bytes > 1000
    assert counters.bad_checksums > 50
    assert flight.end.counters["reboots"] == 0
    assert flight.attitude_error() < 0.01
    assert not flight.told(AlertId.DUPLICATE_SYSTEM_ID)
    assert {m.reset_counter for _, m in flight.vision()} == {0}
    assert len(flight.vision(flight.now_ns - 60 * SECOND)) > 550
    assert flight.longest() <= 512


def nonsense(rng: random.Random, count: int) -> Iterator[Any]:
    """Frames with right checksums and random contents, of every message that is listened to."""
    kinds = [mavlink.mavlink_map[number] for number in sorted(FC_WANTED)]
    reader = FrameReader()
    for _ in range(count):
        kind = rng.choice(kinds)
        sender = rng.choice([(1, 1), (1, 1), (255, 190), (0, 0), (2, 1), (1, 197)])
        yield from reader.feed(frame_of(kind, rng.randbytes(kind.unpacker.size), *sender))


def test_nonsense_with_right_checksums_raises_nothing_and_leaves_nothing(flight):
    ground, link = GroundEnd(flight.shared), SimulatedLink(system_id=1)
    for i, message in enumerate(nonsense(random.Random(0), 4000)):
        flight.end.on_message(flight.link, message, flight.now_ns)  # type: ignore[arg-type]
        ground.on_message(link, message, flight.now_ns)  # type: ignore[arg-type]
        if i % 40 == 0:
            flight.run(0.05)
            ground.on_tick(link, flight.now_ns)  # type: ignore[arg-type]
    assert flight.longest() <= 512
    # Even a lying autopilot is believed again once it speaks the truth.
    flight.reboot()
    flight.run(30.0)
    assert len(flight.vision(flight.now_ns - 10 * SECOND)) > 90
    assert flight.attitude_error() < 0.005
    at = flight.shared.tracker.attitude_at(flight.now_ns - 100 * MS)
    assert math.isfinite(at.yaw_rad)


@pytest.mark.parametrize("jumps", [1, 2])
def test_the_jump_at_a_restart_is_a_change_to_an_autopilot_that_flies_on(monkeypatch, jumps):
    """Each process begins with a jump and counted from 0: ArduPilot had seen a 1 last, and fought
    the place that was found after the gap.
    """
    killed = Flight(monkeypatch)
    for _ in range(jumps):
        killed.reset_count += 1
        killed.run(8.0)
    again = Flight(monkeypatch)
    again.armed, again.reset_count = True, 1
    again.north_m = again.ekf_north_m = 8.0
    again.run(15.0)
    seen = [m.reset_counter for _, m in (*killed.vision()[-1:], *again.vision())]
    changes = [k for k, (a, b) in enumerate(itertools.pairwise(seen)) if a != b]
    assert changes
    assert changes[-1] <= 1  # with the second message at latest, and then no more
    assert again.end.counters["jumps_repeated"] == 0


@pytest.mark.parametrize("taken_at", [1, 2, 4, None])
def test_a_jump_that_the_ekf_missed_is_announced_again(flight, taken_at):
    """ArduPilot's EKF misses the new reset_counter where two messages arrive in one of its steps.

    taken_at: the value of the counter at which this one takes it; None: never.
    """
    flight.north_m, flight.reset_count = 10.0, 1
    for _ in range(200):
        flight.run(0.1)
        counters = {m.reset_counter for _, m in flight.vision()}
        if taken_at in counters:
            flight.ekf_north_m = 10.0
    assert counters == set(range((taken_at or 6) + 1))  # six: announced, and five times again
    again = flight.told(AlertId.JUMP_REPEATED)
    assert len(again) == flight.end.counters["jumps_repeated"] == (taken_at or 6) - 1


@pytest.mark.parametrize("follows_after_s", [0.2, 6.0, None])
def test_after_each_relocalization_it_is_said_once_that_the_ekf_follows(flight, follows_after_s):
    """The pages let the pilot wait for it; it came after the first fix of the flight only.

    follows_after_s: from the jump to where the EKF is at the new place; None: never.
    """
    assert len(flight.told(AlertId.EKF_FOLLOWS)) == 1
    for place in (1, 2):
        flight.north_m, flight.reset_count = 10.0 * place, place
        flight.run(follows_after_s or 0.0)
        assert len(flight.told(AlertId.EKF_FOLLOWS)) == place
        flight.ekf_north_m = flight.north_m if follows_after_s else 0.0
        flight.run(2.5)  # what the EKF was compared with is in part from before
        assert len(flight.told(AlertId.EKF_FOLLOWS)) == place
        flight.run(30.0)
        assert len(flight.told(AlertId.EKF_FOLLOWS)) == (place + 1 if follows_after_s else 1)
        if follows_after_s is None:
            assert flight.told(AlertId.EKF_OFF_FIXES)
            break


def test_an_ekf_that_still_swings_about_the_new_place_does_not_follow(flight: Flight) -> None:
    """After a full loss it swung by 4 m for 12 s: it was said in between, and twice."""
    flight.north_m, flight.ekf_north_m, flight.reset_count = 10.0, 7.5, 1
    flight.run(12.0)
    assert len(flight.told(AlertId.EKF_FOLLOWS)) == 1
    flight.ekf_north_m = 9.5
    flight.run(6.0)
    assert len(flight.told(AlertId.EKF_FOLLOWS)) == 2


def test_that_the_ekf_follows_is_said_after_its_reset_is_confirmed(flight: Flight) -> None:
    flight.end.inhibit(AlertId.EKF_JUMP)
    flight.north_m = flight.ekf_north_m = 10.0
    flight.run(12.0)
    assert len(flight.told(AlertId.EKF_FOLLOWS)) == 1
    flight.end.clear(AlertId.EKF_JUMP)
    flight.run(10.0)
    assert len(flight.told(AlertId.EKF_FOLLOWS)) == 2


def test_a_flood_of_targets_and_commands_leaves_a_slow_link_to_positions(flight: Flight) -> None:
    """A hundred targets at once, and a ground station that orders without end."""
    for i in range(100):
        report = TargetReport(flight.now_ns, *HOME, 500.0, target_id=i, pixel=(0.5, 0.5))
        flight.end.components.queue_item(report)
    told: dict[int, int] = {}
    begun_ns = flight.now_ns
    flight.run(1.0)
    for time_ns, message, _ in flight.link.sent:
        if time_ns > begun_ns and message.get_type() == "CAMERA_TRACKING_GEO_STATUS":
            told[time_ns] = told.get(time_ns, 0) + 1
    assert told
    assert max(told.values()) <= 4
    flight.link.congested = True
    begun_ns = flight.now_ns
    order = mavlink.MAVLink_command_long_message(1, 100, 2004, 0, 0.5, 0.5, 0, 0, 0, 0, 0)
    for _ in range(50):
        flight.say(order, 255, 190)
        flight.run(0.1)
    kinds = {m.get_type() for t, m, _ in flight.link.sent if t > begun_ns}
    assert "VISION_POSITION_ESTIMATE" in kinds
    assert not kinds & {"COMMAND_ACK", "CAMERA_TRACKING_GEO_STATUS"}
    flight.link.congested = False
    flight.say(order, 255, 190)
    assert flight.link.sent[-1][1].get_type() == "COMMAND_ACK"


# --- what else an operator must be told -----------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "component", "autopilot", "said"),
    [
        (2, 1, 3, alert(AlertId.AUTOPILOT_IGNORED, system=2, used=1)),
        (1, 197, 8, alert(AlertId.SECOND_COMPANION, component=197)),
        (1, 2, 3, alert(AlertId.DUPLICATE_SYSTEM_ID, system=1)),
        (255, 190, 8, None),  # a ground station
        (1, 154, 8, None),  # a gimbal
    ],
)
def test_a_second_vehicle_and_a_second_companion_are_told_once(
    flight: Flight, system: int, component: int, autopilot: int, said: Alert | None
) -> None:
    beat = mavlink.MAVLink_heartbeat_message(2, autopilot, 81, 4, 4, 3)
    flight.alerts.clear()
    for _ in range(3):
        kept = flight.link.kept
        flight.say(beat, system, component)
        assert flight.link.kept == kept
        flight.run(1.0)
        assert flight.link.kept == kept + 1  # by the vehicle's own heartbeat
    assert flight.alerts == ([said] if said else [])
    assert flight.shared.tracker.snapshot(flight.now_ns).system_id == 1


@pytest.mark.parametrize("ahead_s", [-50, 500])
def test_two_vehicles_of_the_same_ids_are_told_once(flight: Flight, ahead_s: int) -> None:
    """Only their boot times tell them apart. Nothing of the other's attitude may be injected."""
    flight.alerts.clear()
    for step in range(1000):
        flight.run(0.01)
        if step % 4 == 1:
            boot_ms = flight.boot_ns(flight.now_ns) // MS + ahead_s * 1000
            flight.say(mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0))
    told = flight.told(AlertId.DUPLICATE_SYSTEM_ID)
    assert told == [alert(AlertId.DUPLICATE_SYSTEM_ID, system=1)]
    assert {m.yaw for _, m in flight.vision()}.isdisjoint({-1.0})


def test_a_target_from_the_future_is_not_reported_for_ever(flight: Flight) -> None:
    hour = 3600 * SECOND
    flight.end.components.queue_item(TargetReport(flight.now_ns + hour, *HOME, 500.0))
    flight.run(1.0)
    assert not lengths(flight.end)["targets"]
    assert not [m for _, m, _ in flight.link.sent if m.get_type() == "CAMERA_TRACKING_GEO_STATUS"]


def fault(flight: Flight) -> AlertId | None:
    """What keeps vision from the EKF."""
    found = flight.end.injection_fault
    return None if found is None else found.id


def test_what_keeps_vision_from_the_ekf_stands_as_its_trouble(monkeypatch):
    """A gimbal 10 degrees off, whose fixes the yaw guard refuses; an EKF that is elsewhere."""
    flight = Flight(monkeypatch)
    flight.run(6.0)
    assert flight.end.injection_fault is None
    flight.yaw_error_rad = 0.17
    flight.run(6.0)
    assert fault(flight) is AlertId.YAW_MISMATCH
    flight.yaw_error_rad = 0.0
    flight.run(12.0)
    assert flight.end.injection_fault is None
    flight.ekf_north_m = 20.0
    flight.run(6.0)
    assert fault(flight) is AlertId.EKF_OFF_FIXES


def test_a_blind_yaw_guard_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight(monkeypatch)
    monkeypatch.setattr(flight, "yaw", lambda _: 0.0)
    flight.run(10.0)
    assert not flight.told(AlertId.YAW_UNCHECKED)
    flight.yaw_is_seen = False
    flight.run(10.0)
    assert flight.told(AlertId.YAW_UNCHECKED) == [alert(AlertId.YAW_UNCHECKED)]
    flight.yaw_is_seen = True
    flight.run(5.0)
    assert flight.alerts[-1] == cleared(AlertId.YAW_UNCHECKED)


def test_an_order_that_is_not_acknowledged_is_repeated_and_told_once(monkeypatch):
    flight = Flight(monkeypatch, switch=SourceSwitchConfig(enabled=True))
    flight.run(30.0)
    orders = [m for _, m, _ in flight.link.sent if getattr(m, "command", 0) == 42007]
    assert len(orders) > 10
    assert {m.param1 for m in orders} == {2.0}
    told = flight.told(AlertId.SOURCE_SET_SELECTED)
    assert [a.values[:2] for a in told] == [(2, "GNSS lost")]


@pytest.mark.parametrize(
    ("system", "component", "ours"),
    [(1, 191, True), (0, 0, True), (255, 190, False), (1, 100, False)],
)
def test_answers_to_others_commands_are_not_ours(monkeypatch, system, component, ours):
    """A ground station's refused order must not look like ours."""
    flight = Flight(monkeypatch, switch=SourceSwitchConfig(enabled=True))
    while not any(getattr(m, "command", 0) == 42007 for _, m, _ in flight.link.sent):
        flight.run(1.0)
    ack = mavlink.MAVLink_command_ack_message(42007, 4, 0, 0, system, component)
    flight.say(ack)
    assert flight.end.counters["commands_refused"] == (1 if ours else 0)
    assert bool(flight.told(AlertId.SOURCE_SET_REFUSED)) is ours


def test_no_origin_is_set_while_the_gate_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Alert] = []
    enable = InjectionEnable(InjectionEnableConfig(), opened.append)
    flight = Flight(monkeypatch, enable)
    flight.run(15.0)
    assert flight.origin is None
    assert enable.command(mavlink.MAV_CMD_USER_1, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    flight.run(10.0)
    assert flight.origin is not None
    assert flight.vision()
