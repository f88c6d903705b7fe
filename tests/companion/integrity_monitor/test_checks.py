"""The monitor against attacks on fixes, and in honest flights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from companion.calibration_watch.observation import CalibrationObservation
from companion.geometry import GIMBAL_FROM_CAMERA
from localizer.geometry.pose import matrix_from_quaternion, so3_exp
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import VehicleState, VisionFix
from mavlink_bridge.vehicle.origin import offset
from tests.companion.integrity_monitor.simulated import (
    HEIGHT,
    LATITUDE,
    LONGITUDE,
    Flight,
    Path,
    beside,
    hover,
    jumps,
    leg,
    monitor,
    outside,
    second,
    swung,
)


def frozen(path: Path, since_s: float) -> Path:
    """What a hung camera shows of a path."""
    return lambda at_s: path(min(at_s, since_s))


@pytest.mark.parametrize("path", [hover, leg])
@pytest.mark.parametrize("noise_m", [0.02, 2.0])
def test_an_honest_flight_is_left_alone(path: Path, noise_m: float) -> None:
    """Neither a hover nor a start to 10 m/s costs a fix or a text."""
    flight = Flight(monitor(), path, noise_m=noise_m, claimed_m=noise_m).fly(40.0)
    assert flight.lines == []
    assert flight.held == []
    assert len(flight.passed) == 400


def test_a_position_that_freezes_in_flight_is_told_within_two_seconds_and_believed_again() -> None:
    """At 10 m/s: the IMU felt nothing that would have stopped the aircraft. The EKF holds what was
    wrong: the first fix afterwards must not be fought.
    """

    def thaws(at_s: float) -> tuple[float, float]:
        return leg(12.0 if 12.0 < at_s < 16.0 else at_s)

    flight = Flight(monitor(), leg, thaws, noise_m=0.03).fly(60.0)
    assert flight.told(AlertId.VISION_IMU_MISMATCH) < 14.0
    assert min(flight.held) < 14.0
    assert not [fix for fix in flight.passed if 14.5e9 < fix.time_ns < 16e9]
    assert 16.0 < flight.ended(AlertId.VISION_IMU_MISMATCH) < 55.0
    back = [fix for fix in flight.passed if fix.time_ns > 16e9]
    assert jumps(flight) == [back[0].time_ns * 1e-9]


@dataclass
class Filmed:
    """A flight and its pictures, 0.2 m to a pixel, each with fresh noise: a sensor hung behind an
    encoder that goes on.
    """

    flight: Flight
    looks_at: Path
    light: Callable[[float], float] = lambda at_s: 1.0

    def fly(self, until_s: float) -> Flight:
        """On to a time of the flight, with a picture every 0.1 s."""
        rng = np.random.default_rng(3)
        ground = cv2.resize(rng.integers(40, 215, (150, 400), np.uint8), (800, 2400))
        while self.flight.at_s < until_s:
            north, east = self.looks_at(self.flight.at_s)
            y, x = 60 + 5.0 * north, 200 + 5.0 * east
            shift = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y]])
            picture = cv2.warpAffine(ground, shift, (320, 240))[..., None].astype(np.float64)
            picture *= self.light(self.flight.at_s)
            noisy = np.clip(picture + rng.normal(0.0, 2.0, (240, 320, 3)), 0, 255)
            self.flight.monitor.add_frame(second(self.flight.at_s), noisy.astype(np.uint8))
            self.flight.fly(self.flight.at_s + 0.1)
        return self.flight


def test_a_picture_that_freezes_on_the_way_is_told_before_5_m() -> None:
    """At 10 m/s. By the IMU alone it took 1.4 s, in which 9 m were injected (ArduPilot)."""
    flight = Filmed(Flight(monitor(), leg, frozen(leg, 12.0), noise_m=0.03), frozen(leg, 12.0))
    flight.fly(14.0)
    assert flight.flight.told(AlertId.VIDEO_FROZEN) <= 12.6
    assert not [fix for fix in flight.flight.passed if fix.time_ns > 12.5e9]


def test_fog_is_no_frozen_video() -> None:
    """Found on ArduPilot: a bank of fog was told as a feed that hangs."""
    fog = Flight(monitor(), leg, noise_m=0.03)
    while fog.fly(fog.at_s + 0.1).at_s < 12.0:
        fog.monitor.add_frame(second(fog.at_s), np.full((240, 320, 3), 205, np.uint8))
    assert {one.id for _, one in fog.lines} == {AlertId.LOW_CONTRAST}


def test_low_light_is_told_after_2_s_and_ends_after_5_s_and_holds_nothing() -> None:
    """And a hover, a start and 10 m/s that are filmed in light tell nothing."""
    dark = Filmed(Flight(monitor(), leg, noise_m=0.03), leg, lambda s: 0.02 if 8 <= s < 14 else 1.0)
    flight = dark.fly(22.0)
    assert 10.0 <= flight.told(AlertId.LOW_CONTRAST) <= 10.4
    assert 19.0 <= flight.ended(AlertId.LOW_CONTRAST) <= 19.4
    assert {one.id for _, one in flight.lines} == {AlertId.LOW_CONTRAST}
    assert flight.held == []


def test_a_60_m_reset_does_not_pass_unquestioned() -> None:
    """Held and told at once; what comes back in time is not."""
    relocalized = beside(hover, lambda at_s: (60.0 if 10.0 <= at_s < 13.0 else 0.0, 0.0))
    flight = Flight(monitor(), hover, relocalized, reset_at_s=10.0).fly(20.0)
    assert flight.told(AlertId.POSITION_JUMP) < 10.2
    assert min(flight.held) == pytest.approx(10.0)
    assert max(flight.held) <= 13.1  # until the next step
    assert len(flight.passed) >= 168


def test_a_jump_within_the_alert_limit_passes_if_it_is_announced() -> None:
    """A relocalization after bridging; without a word it is held."""
    relocalized = beside(hover, lambda at_s: (8.0 if at_s >= 10.0 else 0.0, 0.0))
    assert Flight(monitor(), hover, relocalized, reset_at_s=10.0).fly(12.0).held == []
    assert Flight(monitor(), hover, relocalized).fly(12.0).held != []


def late(from_s: float, until_s: float = np.inf) -> Path:
    """What a stream that lags 0.3 s shows of `leg`, stamped as if it did not."""
    return lambda at_s: leg(at_s - 0.3 if from_s <= at_s < until_s else at_s)


def test_positions_of_a_stream_that_begins_to_lag_are_within_their_level() -> None:
    """`late-300ms` at 10 m/s on ArduPilot: 149 of 590 were up to 1.9 times their level off, until a
    turn told of the stamps. The step at its beginning was seen, and below what is held.
    """
    flight = Flight(monitor(), leg, late(12.0), noise_m=0.1, claimed_m=0.1).fly(30.0)
    assert flight.held == []
    assert outside(flight) == []
    assert flight.told(AlertId.POSITION_STEP) <= 12.5
    assert flight.passed[-1].protection_m is not None
    assert flight.passed[-1].protection_m[0] < 6.0  # a bound, not a refusal
    # The EKF was told 0.1 m of positions 3 m behind: it believed them, and turned its yaw away.
    told = [np.sqrt(fix.position_covariance_ned[0, 0]) for fix in flight.passed]
    assert max(told[:100]) == pytest.approx(0.1)
    assert 2.5 < min(told[-100:]) <= max(told[-100:]) < 3.5


def test_a_lag_that_ends_leaves_no_doubt() -> None:
    """The step back takes away what the step had brought: told once as over, level as before."""
    flight = Flight(monitor(), leg, late(12.0, 20.0), noise_m=0.1, claimed_m=0.1).fly(30.0)
    before = next(fix for fix in flight.passed if fix.time_ns >= second(11.5))
    assert flight.passed[-1].protection_m == pytest.approx(before.protection_m, abs=0.01)
    assert flight.passed[-1].position_covariance_ned[0, 0] == pytest.approx(0.1**2)
    assert [(one.id, one.active) for _, one in flight.lines] == [
        (AlertId.POSITION_STEP, True),
        (AlertId.POSITION_STEP, False),
    ]


def test_a_step_aside_is_settled_where_the_place_is_found_anew() -> None:
    """2 m across the way: a second likely place beside the first, and who knows which is true."""
    aside = beside(leg, lambda at_s: (0.0, 2.0 if at_s >= 12.0 else 0.0))
    flight = Flight(monitor(), leg, aside, noise_m=0.1, claimed_m=0.1, reset_at_s=20.0).fly(24.0)
    assert flight.told(AlertId.POSITION_STEP) <= 12.5
    assert 20.0 <= flight.ended(AlertId.POSITION_STEP) <= 20.2


@pytest.mark.parametrize("accuracy_m", [1.0, 12.0])
def test_gnss_apart_from_vision_is_told_as_long_as_it_lasts(accuracy_m: float) -> None:
    """However bad the receiver claims to be: 12 m times a number of sigma would excuse 60 m. One
    that is gone is not told as apart for the rest of the flight.
    """
    flight = Flight(monitor(), gnss_north_m=lambda _: 20.0, gnss_accuracy_m=accuracy_m).fly(15.0)
    told = flight.times(AlertId.GNSS_VISION_MISMATCH)
    assert told[0] < 4.0
    assert np.diff(told) == pytest.approx([10.0], abs=0.5)
    flight.gnss_north_m = None
    assert len(flight.fly(40.0).lines) == 2
    flight.gnss_north_m = lambda _: 20.0  # and as soon as it is there again, it is
    assert len(flight.fly(42.0).lines) == 3
    assert flight.held == []  # neither is said to be right
    ours = Flight(monitor(gnss_is_ours=True), gnss_north_m=lambda _: 20.0).fly(10.0)
    assert ours.lines == []  # agreement or not with what we fed ourselves is no evidence


def test_a_receiver_that_lags_is_left_alone_and_a_dragged_one_is_told_at_speed() -> None:
    """At 10 m/s a report that is 0.3 s old when it comes is 3 m behind; 10 m are told all the same.

    Found on ArduPilot: 0.6 m/s of spoofing was told at 13 m in flight, at 8 m in a hover.
    """

    def behind(at_s: float) -> float:
        return leg(at_s - 0.3)[0] - leg(at_s)[0]

    honest = Flight(monitor(), leg, gnss_north_m=behind).fly(16.0)
    assert honest.lines == []
    dragged = Flight(monitor(), leg, gnss_north_m=lambda at_s: -0.6 * max(at_s - 10.0, 0.0))
    assert 0.6 * (dragged.fly(40.0).told(AlertId.GNSS_VISION_MISMATCH) - 10.0) < 10.0


class Twice(Flight):
    """Two flights of one process, on the ground from 20 to 40 s; meanwhile the weather changed."""

    weather_m = 17.0

    def state(self) -> VehicleState:
        on_ground, later = 20.0 <= self.at_s < 40.0, self.at_s >= 30.0
        return replace(
            super().state(),
            armed=not on_ground,
            pressure_altitude_m=500.0 + (self.weather_m if later else 0.0),
        )


def test_the_weather_between_two_flights_is_no_finding_and_a_height_is_watched_anew() -> None:
    """2 hPa in some hours are 17 m: the second flight was withheld from its first position on, and
    to its end, because the zero of the first stood while it was off.
    """
    flight = Twice(monitor()).fly(50.0)
    assert flight.lines == []
    assert flight.held == []

    def height(at_s: float) -> float:
        return 30.0 if 10.0 <= at_s < 20.0 or at_s >= 50.0 else 0.0

    flight = Twice(monitor(), height_m=height).fly(55.0)
    assert flight.times(AlertId.HEIGHT_MISMATCH) == pytest.approx([12.8, 52.8], abs=1.0)
    assert not [at_s for at_s in flight.held if 27.0 < at_s < 50.0]


def climb(at_s: float) -> float:
    return min(5.0 * max(at_s - 10.0, 0.0), 100.0)


@dataclass
class InAir(Flight):
    """Climbs at 5 m/s by 100 m; the barometer's altitude is of the standard atmosphere, which is
    15 degrees at sea level. celsius: the air's.
    """

    celsius: float = 15.0

    def state(self) -> VehicleState:
        standard = climb(self.at_s) * 288.15 / (self.celsius + 273.15)
        return replace(super().state(), pressure_altitude_m=500.0 + standard)


@pytest.mark.parametrize("celsius", [-25.0, 45.0])
def test_a_climb_through_cold_or_hot_air_is_no_finding_and_half_of_one_is(celsius: float) -> None:
    """At -25 degrees 100 m are 116 by the barometer: withheld at 60 m, and for the whole flight,
    because its zero stands while it is off. Who sees 50 m of 100 sees another place's ground.
    """
    flight = InAir(monitor(), height_m=climb, celsius=celsius).fly(40.0)
    assert flight.lines == []
    assert flight.held == []
    flight = InAir(monitor(), height_m=lambda at_s: 0.5 * climb(at_s), celsius=celsius).fly(40.0)
    assert flight.told(AlertId.HEIGHT_MISMATCH) < 21.0
    assert max(flight.held) > 39.0


def around(at_s: float, scale: float = 1.0) -> tuple[float, float]:
    """Out of a hover and round and round, 40 m about a place, with 10 m/s."""
    angle = leg(at_s)[0] / 40.0
    return scale * 40.0 * np.sin(angle), scale * 40.0 * (1.0 - np.cos(angle))


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.1])
def test_odometry_beyond_the_alert_limit_moves_right(scale: float) -> None:
    """In a turn, with the scale error of ground taken as level."""
    flight = Flight(monitor(), around, lambda at_s: around(at_s, scale), noise_m=0.03)
    flight.fly(8.0)
    flight.claimed_m, flight.by_odometry = 20.0, True
    flight.fly(60.0)
    assert {alert.id for _, alert in flight.lines} == {AlertId.HPL_OVER_LIMIT}
    assert flight.moved == flight.held
    assert len(flight.moved) > 500


@pytest.mark.parametrize("lie", [
    pytest.param(lambda at_s: leg(min(at_s, 20.0)), id="frozen"),
    pytest.param(lambda at_s: leg(max(at_s, 2.0 * at_s - 20.0)), id="twice"),
])  # fmt: skip
def test_odometry_that_moves_otherwise_gives_no_velocity(lie: Path) -> None:
    """A picture that freezes; ground that rises to half of the height above it at once."""
    flight = Flight(monitor(), leg, lie, noise_m=0.03, claimed_m=20.0, by_odometry=True).fly(40.0)
    assert 19.8 < max(flight.moved) < 23.0


@pytest.mark.parametrize("raise_s", [0.3, 3.0])
def test_the_alert_limit_is_told_within_the_time_to_alert(raise_s: float) -> None:
    """What passes says how wrong it may be; what may be more wrong than the limit does not pass."""
    flight = Flight(monitor(time_to_alert_s=raise_s), claimed_m=0.3, noise_m=0.1).fly(5.0)
    levels = [fix.protection_m for fix in flight.passed]
    assert all(level is not None and 0.0 < level[0] < 10.0 for level in levels)
    flight.claimed_m = 3.5
    flight.fly(12.0)
    assert 5.0 < flight.told(AlertId.HPL_OVER_LIMIT) <= 5.0 + min(raise_s, 1.0) + 0.21
    flight.claimed_m = 0.3
    flight.fly(15.6)
    assert 15.0 <= flight.ended(AlertId.HPL_OVER_LIMIT) < 15.5  # 3 s below it, or it would flap
    assert 11.8 < max(flight.held) < 15.5
    assert flight.moved == []


def test_an_alert_limit_that_is_touched_now_and_then_does_not_flap() -> None:
    """One fix in ten beyond it: neither told nor withheld."""
    flight = Flight(monitor(), noise_m=0.1)
    for tenth in range(1, 100):
        flight.claimed_m = 3.5 if tenth % 10 == 0 else 0.3
        flight.fly(0.1 * tenth)
    assert flight.lines == []
    assert flight.held == []


def looking(flight: Flight, yaw_off_deg: float) -> CalibrationObservation:
    """What the map says of a camera that looks 45 degrees down, north but for an angle."""
    now_ns = second(flight.at_s)
    gimbal = flight.gimbal_at(now_ns)
    reported = matrix_from_quaternion(gimbal.quaternion) @ GIMBAL_FROM_CAMERA
    turned = so3_exp(np.array([0.0, 0.0, np.radians(yaw_off_deg)])) @ reported
    return CalibrationObservation(now_ns, (LATITUDE, LONGITUDE, HEIGHT), 0.1, turned, 85.0, 60.0)


@pytest.mark.parametrize(("off_deg", "told"), [(4.0, True), (-12.0, True), (1.5, False)])
def test_a_camera_that_is_mounted_wrong_is_told_and_injection_does_not_begin(off_deg, told):
    """It is no reason to take back what already flies: positions do not depend on it."""
    watched = monitor()
    flight = Flight(watched, noise_m=0.1)
    for quarter in range(1, 37):
        flight.fly(0.25 * quarter)
        watched.add_observation(looking(flight, off_deg))
    assert [one.id for _, one in flight.lines] == ([AlertId.BORESIGHT] if told else [])
    assert watched.inhibiting == ({AlertId.BORESIGHT} if told else set())
    assert flight.held == []
    if told:
        assert flight.told(AlertId.BORESIGHT) < 9.0
    if off_deg == 4.0:
        for quarter in range(37, 110):  # put right
            flight.fly(0.25 * quarter)
            watched.add_observation(looking(flight, 0.0))
        assert flight.ended(AlertId.BORESIGHT) < 27.0
        assert watched.inhibiting == set()


def test_a_frozen_picture_is_no_evidence_of_its_stamps() -> None:
    """A frozen hover was blamed on the time stamps, 413 ms late (ArduPilot): the place stands, and
    the aircraft moves.
    """
    watched, shown = monitor(), frozen(swung, 12.0)
    filmed = Filmed(Flight(watched, swung, shown, noise_m=0.05), shown)
    flight = filmed.flight
    while flight.at_s < 26.0:
        # Until the freeze every tenth picture is enough.
        (filmed if flight.at_s > 11.0 else flight).fly(flight.at_s + 0.25)
        place = offset(LATITUDE, LONGITUDE, *shown(flight.at_s))
        watched.add_observation(replace(looking(flight, 0.0), place=(*place, HEIGHT)))
    assert min(flight.told(AlertId.VIDEO_FROZEN), flight.told(AlertId.VIDEO_REPEATS)) < 16.0
    for of in (AlertId.TIME_OFFSET, AlertId.FOCAL_LENGTH, AlertId.BORESIGHT):
        assert not flight.times(of)


class WithoutPosition(Flight):
    """Its EKF lost its position at 10 m/s, 30 s before, and says none any more: what it said last
    stands. The pilot has stopped it since.
    """

    said_s = -30.0

    def state(self) -> VehicleState:
        return replace(
            super().state(), local_velocity_ned=(10.0, 0.0, 0.0), local_time_ns=second(self.said_s)
        )


def calm(at_s: float) -> tuple[float, float]:
    """A hover without wind: 0.02 m, which a picture shows, take 1.3 s."""
    return hover(0.1 * at_s)


def test_a_speed_of_before_the_ekf_lost_its_position_makes_no_picture_frozen() -> None:
    """The place was found again, and withheld as `video frozen 0 s` every other second."""
    flight = Filmed(WithoutPosition(monitor(), calm, noise_m=0.03), calm).fly(20.0)
    assert flight.lines == []
    assert flight.held == []


def test_a_speed_of_before_the_ekf_lost_its_position_makes_no_level_small() -> None:
    """It hovered when it lost it, and may fly at any speed since."""
    fix = VisionFix(second(2.0), LATITUDE, LONGITUDE, HEIGHT)
    hovered = replace(Flight(monitor()).state(), local_velocity_ned=(0.0, 0.0, 0.0))
    levels = [
        passed.protection_m[0]
        for said_ns in (fix.time_ns, second(-30.0))
        if (passed := monitor().admit(fix, replace(hovered, local_time_ns=said_ns))) is not None
        and passed.protection_m is not None
    ]
    assert levels[1] > levels[0]
