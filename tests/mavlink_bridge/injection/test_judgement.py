"""Shadow score, closed-loop check and source switching, without any link."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import RcChannel
from mavlink_bridge.config import InjectionConfig, InjectionEnableConfig, SourceSwitchConfig
from mavlink_bridge.gnss_return import GnssReturnCheck
from mavlink_bridge.injection.fix_sender import FixWarnings
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.injection.outcome import ClosedLoopCheck, LoopVerdict
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.injection.shadow import ShadowScore, ShadowScorer
from mavlink_bridge.injection.switching import SourceSwitch
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.profile import ARDUPILOT, GENERIC, FirmwareProfile
from tests.mavlink_bridge.simulated import HOME, METRE, MS, SECOND

GOOD_FLAGS = 831


def position(
    time_ns: int, north: float = 0.0, sigma: float = 0.5, speed: float = 0.0
) -> PropagatedFix:
    return PropagatedFix(
        time_ns,
        HOME[0] + north * METRE,
        HOME[1],
        600.0,
        np.eye(3) * sigma**2,
        np.array([speed, 0.0, 0.0]),
        np.eye(3) * 0.01,
    )


def vehicle(now_ns: int = SECOND, **options: Any) -> VehicleState:
    return replace(
        VehicleState(
            connected=True,
            autopilot="ardupilot",
            ekf_flags=GOOD_FLAGS,
            ekf_horizontal_variance=0.1,
            gps_fix_type=3,
            gps_latitude_deg=HOME[0],
            gps_longitude_deg=HOME[1],
            gps_h_accuracy_m=1.0,
            gps_time_ns=now_ns,
        ),
        **options,
    )


# --- shadow -------------------------------------------------------------------------------------


def scored(
    error_m: float = 0.1,
    *,
    sigma: float = 0.5,
    hz: float = 10.0,
    seconds: float = 10.0,
    altitude: float = 500.0,
    yaw_deg: float | None = None,
) -> ShadowScore:
    """Fixes at 600 m above the ellipsoid with 100 m of geoid, and what the autopilot has."""
    rng = np.random.default_rng(1)
    scorer = ShadowScorer(100.0)
    for i in range(int(hz * seconds)):
        north = error_m + rng.normal(0.0, 0.2)
        scorer.compare(position(int(i * SECOND / hz), north, sigma), (*HOME, altitude))
    return scorer.score(int(seconds * SECOND), None if yaw_deg is None else math.radians(yaw_deg))


def test_good_vision_is_a_go() -> None:
    score = scored(0.5, altitude=493.0)
    assert score.ready
    assert score.samples == 100
    assert score.median_m == pytest.approx(0.5, abs=0.1)
    assert score.bias_ne_m == pytest.approx((0.5, 0.0), abs=0.1)
    assert score.rate_hz == pytest.approx(10.0)
    assert score.height_m == pytest.approx(7.0)
    assert score.line().startswith("ready: median 0.5 m")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"error_m": 4.0, "sigma": 4.0}, AlertId.SHADOW_MEDIAN),
        ({"error_m": 2.9 * 2, "sigma": 0.1}, AlertId.SHADOW_COVARIANCE),
        ({"seconds": 3.0}, AlertId.SHADOW_FEW_FIXES),
        ({"hz": 2.0, "seconds": 40.0}, AlertId.SHADOW_RATE),
        ({"seconds": 0.0}, AlertId.SHADOW_NOT_COMPARED),
        ({"yaw_deg": 5.0}, AlertId.SHADOW_YAW),
        # A geoid that is missing, or of the wrong sign.
        ({"altitude": 547.0}, AlertId.SHADOW_HEIGHT),
        ({"altitude": 406.0}, AlertId.SHADOW_HEIGHT),
    ],
)
def test_bad_vision_is_a_no_go_with_its_reason(options: dict[str, float], reason: AlertId) -> None:
    score = scored(**options)
    assert not score.ready
    assert reason in {r.id for r in score.reasons}
    assert score.line().startswith("not ready: ")
    assert (score.median_m is None) is (reason is AlertId.SHADOW_NOT_COMPARED)


# --- closed loop --------------------------------------------------------------------------------


def looped(
    ekf_north: float | None = 0.0, hz: float = 10.0, message: Any = "odometry", **options: Any
) -> LoopVerdict | None:
    check = ClosedLoopCheck(message)
    for i in range(int(hz * 8)):
        now = int(i * SECOND / hz)
        check.add_sent(now - 100 * MS, now, 0.0, 0.0, 0.5)
    local = None if ekf_north is None else (ekf_north, 0.0, -60.0)
    return check.verdict(8 * SECOND, vehicle(**options), lambda _: local)


def test_followed_position_is_used() -> None:
    verdict = looped(0.4)
    assert verdict == LoopVerdict(True, None, pytest.approx(0.4))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"ekf_north": 30.0}, AlertId.EKF_OFF_FIXES),
        ({"ekf_north": None}, AlertId.EKF_NO_POSITION),
        ({"ekf_flags": 128 | 1}, AlertId.EKF_NO_SOURCE),
        ({"ekf_flags": 1024}, AlertId.EKF_NOT_INITIALISED),
        ({"ekf_horizontal_variance": 1.4}, AlertId.EKF_REJECTS_FIXES),
        ({"hz": 2.0}, AlertId.FIX_RATE_LOW),
        ({"message": "gps_input", "hz": 4.5}, AlertId.FIX_RATE_LOW),
        ({"message": "gps_input", "ekf_flags": 128}, AlertId.EKF_NO_SOURCE),
    ],
)
def test_reason_in_one_line(options: dict[str, Any], reason: AlertId) -> None:
    verdict = looped(**options)
    assert not verdict.used
    assert verdict.reason.id is reason


def test_no_verdict_before_it_has_settled_or_after_sending_ended() -> None:
    check = ClosedLoopCheck("odometry")
    for i in range(20):
        check.add_sent(i * 100 * MS, i * 100 * MS, 0.0, 0.0, 0.5)
    assert check.verdict(2 * SECOND, vehicle(), lambda _: (0.0, 0.0, 0.0)) is None
    assert check.verdict(60 * SECOND, vehicle(), lambda _: (0.0, 0.0, 0.0)) is None


def test_a_jump_after_one_that_was_given_up_is_repeated_again() -> None:
    """The five repeats of the first were those of the whole flight."""
    check, now, counter, repeats = ClosedLoopCheck("odometry"), 0, 0, []

    def fly(seconds: float, off: float) -> None:
        nonlocal now, counter
        for _ in range(int(seconds * 10)):
            now += 100 * MS
            check.add_sent(now - 100 * MS, now, 0.0, 0.0, 0.5, counter)
            check.verdict(now, vehicle(), lambda _: (off, 0.0, -60.0))
            if check.is_jump_missed():
                repeats.append(now)
                counter += 1

    fly(5.0, off=0.0)
    for _ in range(2):
        counter, repeats = counter + 1, []
        fly(30.0, off=20.0)  # not to be moved
        assert len(repeats) == 5
        fly(10.0, off=0.0)  # it came by itself


# --- source switch ------------------------------------------------------------------------------

CONFIG = SourceSwitchConfig(enabled=True, bad_after_s=1.5)


class Switch(SourceSwitch):
    """Whose orders are acknowledged. told: the alerts."""

    def __init__(self, config: SourceSwitchConfig = CONFIG) -> None:
        self.told: list[Alert] = []
        self._sent: list[int] = []
        commander: Any = SimpleNamespace(send=lambda _, __, number: self._sent.append(number))
        super().__init__(config, commander, StatusNotifier(self.told.append), Counter())

    def told_of(self, of: AlertId) -> list[tuple[Any, ...]]:
        return [told.values for told in self.told if told.id is of]

    def drive(self, seconds: float, start: float = 0.0, **how: Any) -> list[tuple[float, int]]:
        """Decide ten times a second; times and sets of the orders. how: see the body."""
        orders = []
        for i in range(int(seconds * 10)):
            now = int((start + i / 10) * SECOND) + SECOND
            gps = how.get("gps", True)
            state = vehicle(
                now if gps else 0,
                gps_fix_type=3 if gps else 0,
                ekf_flags=GOOD_FLAGS | how.get("flags", 0),
                gps_h_accuracy_m=how.get("claimed", 1.0),
                latitude_deg=HOME[0] + how.get("ekf", how.get("north", 0.0)) * METRE,
                longitude_deg=HOME[1],
            )
            seen = now - (100 * MS if how.get("seen", True) else 60 * SECOND)
            vision = position(seen, how.get("north", 0.0), speed=how.get("speed", 0.0))
            good, may_switch = how.get("good", True), how.get("proven", True)
            link: Any = None
            self.tick(link, state, vision, good=good, may_switch=may_switch, now_ns=now)
            if self._sent:
                orders.append((start + i / 10, self._sent.pop()))
                self.acknowledged(True)
        return orders


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({"gps": False}, "GNSS lost"),
        ({"flags": 32768}, "GNSS glitch"),
        ({"north": 12.0}, "GNSS off vision"),
    ],
)
def test_bad_gnss_switches_once_to_vision(how: dict[str, Any], reason: str) -> None:
    switch = Switch()
    assert switch.drive(5.0) == []
    ((ordered_s, source_set),) = switch.drive(6.0, 5.0, **how)
    assert ordered_s == pytest.approx(6.5, abs=0.15)
    assert source_set == 2
    assert [values[:2] for values in switch.told_of(AlertId.SOURCE_SET_SELECTED)] == [(2, reason)]
    assert switch.current == 2


def test_short_fault_switches_nothing() -> None:
    switch = Switch()
    for i in range(10):
        assert switch.drive(1.0, 4.0 * i, gps=False) == []
        assert switch.drive(3.0, 4.0 * i + 1.0) == []


@pytest.mark.parametrize(
    ("config", "how"),
    [
        (CONFIG, {"north": 8.0, "speed": 15.0}),  # the lag of a fast flight
        (CONFIG, {"gps": False, "good": False}),  # to vision that is not good
        (CONFIG, {"north": 20.0, "claimed": 12.0}),
        (SourceSwitchConfig(), {"gps": False}),  # disabled
    ],
)
def test_what_switches_nothing(config: SourceSwitchConfig, how: dict[str, Any]) -> None:
    assert Switch(config).drive(10.0, **how) == []


def test_a_receiver_that_claims_to_be_bad_hides_nothing() -> None:
    switch = Switch()
    switch.drive(5.0, north=60.0, claimed=12.0)
    assert [why for _, why, _ in switch.told_of(AlertId.SOURCE_SET_SELECTED)] == ["GNSS off vision"]


def test_back_to_gnss_only_if_configured_and_once_it_was_compared() -> None:
    never = Switch()
    never.drive(5.0, gps=False)
    assert never.drive(60.0, 5.0) == []
    back = Switch(CONFIG.model_copy(update={"return_to_gnss": True}))
    back.drive(5.0, gps=False)
    for i in range(5):
        # A receiver that comes and goes does not bring it back.
        assert back.drive(4.5, 5.0 + 10 * i) == []
        assert back.drive(5.5, 9.5 + 10 * i, gps=False) == []
    orders = back.drive(10.0, 55.0)
    assert [source_set for _, source_set in orders] == [1]


def test_no_return_to_a_far_receiver_of_which_nobody_says_that_it_is_bad() -> None:
    """Vision ended, and with it the only word against a spoofed receiver that says it is well."""
    back = Switch(CONFIG.model_copy(update={"return_to_gnss": True}))
    back.drive(5.0, north=60.0)
    assert back.current == 2
    assert back.drive(60.0, 5.0, seen=False, ekf=60.0) == []
    orders = back.drive(12.0, 65.0)
    assert [source_set for _, source_set in orders] == [1]


def test_no_switch_without_a_go_of_the_shadow_score() -> None:
    switch = Switch()
    assert switch.drive(10.0, proven=False, gps=False) == []
    assert {why for *_, why in switch.told_of(AlertId.SOURCE_SET_HELD)} == {"not ready"}


def test_back_to_sound_gnss_once_vision_is_gone() -> None:
    switch = Switch()
    switch.drive(5.0, gps=False)
    assert switch.drive(20.0, 5.0, gps=False, seen=False) == []
    orders = switch.drive(6.0, 25.0, seen=False)
    assert [source_set for _, source_set in orders] == [1]
    assert orders[0][0] == pytest.approx(28.0, abs=0.2)
    other = Switch()
    other.drive(5.0, gps=False)
    # Not to one that is far from where the vehicle went by itself, and not for a gap in vision.
    assert other.drive(20.0, 5.0, seen=False, ekf=60.0) == []
    other.drive(5.0, 25.0, ekf=60.0)
    assert other.drive(2.0, 30.0, seen=False) == []


# --- a receiver that returns --------------------------------------------------------------------


def returned(
    error: Callable[[float], float],
    *,
    claimed: float | None = 1.0,
    speed: float = 0.0,
    ekf_speed: float | None = None,
    seconds: float = 10.0,
    hz: int = 5,
) -> GnssReturnCheck:
    """What is found of a receiver that is error(t) metres off, north, in a flight northwards.

    ekf_speed: where it differs from vision's.
    """
    check, rng = GnssReturnCheck(), np.random.default_rng(4)
    for i in range(int(seconds * 10)):
        t = i / 10
        now = int(t * SECOND) + SECOND
        report = i * hz // 10 / hz
        at = speed * (report - 0.15) + error(report) + float(rng.normal(0, 0.1))
        state = vehicle(
            int(report * SECOND) + SECOND,
            gps_latitude_deg=HOME[0] + at * METRE,
            gps_h_accuracy_m=claimed,
            local_velocity_ned=(speed if ekf_speed is None else ekf_speed, 0.0, 0.0),
        )
        seen = position(now - 100 * MS, speed * (t - 0.1) + float(rng.normal(0, 0.3)), speed=speed)
        check.update(state, seen, now)
    return check


@pytest.mark.parametrize("speed", [0.0, 15.0])
@pytest.mark.parametrize("claimed", [0.3, None, 4.0])
def test_a_right_receiver_is_accepted(speed: float, claimed: float | None) -> None:
    assert returned(lambda _: 1.0, speed=speed, claimed=claimed, seconds=5.5).accepted
    assert not returned(lambda _: 1.0, speed=speed, claimed=claimed, seconds=4.5).accepted
    assert returned(lambda _: 1.0, speed=speed, claimed=claimed, seconds=6.5, hz=1).accepted


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"error": lambda _: 300.0}, "m off vision"),
        ({"error": lambda _: 20.0, "claimed": 4.9}, "m off vision"),
        ({"error": lambda t: max(8.0 - t, -2.0)}, "m/s off vision"),
        ({"error": lambda t: 5.5 + 0.4 * t, "claimed": 4.5, "seconds": 6.5}, "m off vision"),
        ({"error": lambda t: (-1.0) ** round(5 * t) * (3.0 + t)}, "m noise"),
        # It jumps to and fro by less than it claims to be wrong.
        ({"error": lambda t: 6.0 * (t // 3 % 2), "claimed": 3.0, "seconds": 7.5}, "m noise"),
        ({"error": lambda _: 0.0, "claimed": 8.0}, "m claimed"),
        ({"error": lambda _: -12.0, "speed": 10.0}, "m off vision"),  # 1.2 s late
        ({"error": lambda _: 0.0, "ekf_speed": 2.0}, "m/s off IMU"),
    ],
)
def test_a_wrong_receiver_is_refused_with_its_reason(how: dict[str, Any], why: str) -> None:
    check = returned(**how)
    assert not check.accepted
    assert check.refusal.why == why


def test_what_was_refused_is_not_taken_when_vision_ends() -> None:
    """20 m from where the EKF came by itself would do, but vision had said that it is wrong."""
    switch = Switch()
    switch.drive(5.0, gps=False)
    switch.drive(5.0, 5.0, north=20.0)
    assert switch.drive(20.0, 10.0, north=20.0, seen=False) == []
    switch.drive(5.0, 30.0, gps=False, seen=False)
    assert [source_set for _, source_set in switch.drive(8.0, 35.0, seen=False)] == [1]


# --- Who opens and closes the gate of mode ``rc``: the newest word of channel or command --------


COMMAND = mavlink.MAV_CMD_USER_1


def enable(**options: object) -> tuple[InjectionEnable, list[Alert]]:
    told: list[Alert] = []
    return InjectionEnable(InjectionEnableConfig(**options), told.append), told  # type: ignore[arg-type]


def channels(pulse: int, count: int = 18) -> tuple[int, ...]:
    return tuple(pulse if i == 9 else 1500 for i in range(1, count + 1))


def test_a_pulse_at_the_threshold_does_not_flutter_and_each_change_is_told_once() -> None:
    it, told = enable(inject_above_us=1700)
    for pulse in (1100, 1690, 1705, 1690, 1702, 1655):
        it.on_rc_channels(channels(pulse))
    assert it.enabled
    for pulse in (1640, 1640):
        it.on_rc_channels(channels(pulse))
    assert not it.enabled
    changes = (AlertId.INJECTION_ON, AlertId.INJECTION_OFF)
    assert told == [alert(of, by=RcChannel(9)) for of in changes]


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


# --- What is told of the firmware ---------------------------------------------------------------


def told(message: Any, profile: FirmwareProfile) -> set[AlertId]:
    told: dict[str, Alert | None] = {}
    config = SimpleNamespace(injection=InjectionConfig(message=message))
    shared: Any = SimpleNamespace(config=config, utc=None)
    notifier: Any = SimpleNamespace(notify=told.__setitem__)
    unused: Any = None
    warnings = FixWarnings(shared, unused, notifier)
    warnings.check_firmware(VehicleState(connected=True, version=(1, 0, 0)), profile)
    return {problem.id for problem in told.values() if problem is not None}


def test_unknown_firmware_does_not_hide_that_it_does_not_take_the_message() -> None:
    both = {AlertId.UNKNOWN_FIRMWARE, AlertId.MESSAGE_UNSUPPORTED}
    assert told("odometry", GENERIC) == both
    assert told("vision_position_estimate", GENERIC) == {AlertId.UNKNOWN_FIRMWARE}
    assert told("global_position_sensor", ARDUPILOT) == {AlertId.MESSAGE_UNSUPPORTED}
    assert told("odometry", ARDUPILOT) == set()
