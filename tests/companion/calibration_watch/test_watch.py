"""The calibration watch: each fault found within a minute, honest flights left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.calibration_watch.observation import CalibrationObservation
from companion.calibration_watch.watch import BORESIGHT_DEG, FOCAL_SHARE, TIME_S, CalibrationFigures
from mavlink_bridge import quaternion as quat
from mavlink_bridge.messages import GimbalAttitude, VehicleState
from tests.companion.calibration_watch.simulated import Flown, Wrong, square

SURVEYED = square(60.0)  # climbs to its height on GNSS, then turns
DENIED = square(60.0, climb_s=0.0)


CORNERS = square(60.0, leg_s=10.0, climb_s=0.0)
LATE = Wrong(late_s=0.3, late_from_s=8.0)


class Dragged(Flown):
    """An EKF whose heading late positions turn away: 5.6 degrees from 40 s on."""

    def gimbal_at(self, time_ns: int) -> GimbalAttitude:
        q = super().gimbal_at(time_ns).quaternion
        away = float(np.radians(np.clip(time_ns * 1e-9 - 40.0, 0.0, 8.0) * 0.7))
        turned = quat.multiply(quat.from_euler(0.0, 0.0, away), q)
        return GimbalAttitude(time_ns, 0.0, 0.0, 0.0, turned, "test")


def findings(figures: CalibrationFigures) -> set[str]:
    """What is beyond its limit."""
    found = {
        "focal": figures.focal.exceeds(FOCAL_SHARE),
        "time": figures.late_s.exceeds(TIME_S),
        "boresight": figures.boresight_deg.exceeds(BORESIGHT_DEG),
    }
    return {name for name, is_found in found.items() if is_found}


def ever(flown: Flown) -> set[str]:
    """What was found at any time."""
    return set().union(*(findings(figures) for _, figures in flown.found))


def lost(_: float) -> bool:
    """GNSS, all the time."""
    return False


@pytest.mark.parametrize("seed", range(4))
def test_an_honest_flight_has_no_finding(seed: int) -> None:
    """With what sensors are honestly off by, each flight its own: a receiver 2 m, a compass 2
    degrees, a barometer on a hot day 7 %, a tilt of half a degree, a map 1 m. Half of them denied.
    """
    rng = np.random.default_rng(seed)
    gnss, shift = rng.normal(0.0, 1.0, 2), rng.normal(0.0, 0.7, 2)
    wrong = Wrong(
        focal=float(rng.normal(0.0, 0.003)),
        boresight_deg=(float(rng.normal(0.0, 0.5)), float(rng.normal(0.0, 0.5))),
        late_s=float(rng.normal(0.0, 0.01)),
        pressure_scale=float(rng.uniform(-0.07, 0.07)),
        gnss_m=(float(gnss[0]), float(gnss[1])),
        compass_deg=float(rng.uniform(-2.0, 2.0)),
        map_m=(float(shift[0]), float(shift[1])),
        tilt_deg=float(rng.uniform(-0.5, 0.5)),
    )
    denied = seed % 2 == 1
    flown = Flown(
        wrong, DENIED if denied else SURVEYED, lost if denied else lambda _: True, seed=seed
    ).fly()
    assert ever(flown) == set()


@pytest.mark.parametrize(
    ("wrong", "finding", "denied"),
    [
        (Wrong(focal=0.05), "focal", False),
        (Wrong(focal=-0.05, pressure_scale=0.05), "focal", True),
        (Wrong(late_s=0.12), "time", False),
        (Wrong(late_s=0.3, late_from_s=8.0), "time", True),
        (Wrong(boresight_deg=(4.0, 0.0)), "boresight", False),
    ],
)
def test_a_wrong_calibration_is_found_within_a_minute(wrong, finding, denied):
    """And nothing else is; under denial from the IMU, the turns and the barometer alone."""
    flown = Flown(wrong, DENIED if denied else SURVEYED, lost if denied else lambda _: True).fly()
    assert ever(flown) == {finding}
    at_s, figures = next(row for row in flown.found if finding in findings(row[1]))
    assert at_s < 60.0
    last = flown.found[-1][1]
    true, said = {
        "focal": (wrong.focal, last.focal.value),
        "time": (wrong.late_s, last.late_s.value),
        "boresight": (wrong.boresight_deg[0], last.boresight_deg.value),
    }[finding]
    assert said == pytest.approx(true, rel=0.35)
    assert figures.axis == "yaw" or finding != "boresight"


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_stamps_in_doubt_are_known_again(late_s: float) -> None:
    """From 20 s on, in a straight leg: what was known before does not outweigh what comes (it did:
    0.3 s were 0.12 after 40 s, and the first step tells them).
    """

    class Doubted(Flown):
        def _sighting(self, at_s: float) -> CalibrationObservation:
            if at_s == 20.0:
                self.watch.suspect_timestamps(20_000_000_000)
            return super()._sighting(at_s)

    flown = Doubted(Wrong(late_s=late_s, late_from_s=20.0), square(60.0, climb_s=0.0), lost).fly()
    soon = next(figures for at_s, figures in flown.found if at_s >= 25.0)
    for late in (soon.late_s, flown.found[-1][1].late_s):
        assert late.is_within(0.15) == (late_s == 0.0)
        assert late.exceeds(TIME_S) == (late_s > 0.0)


@pytest.mark.parametrize(
    ("focal", "seconds", "denied"), [(0.2, 3.0, False), (0.05, 0.0, True), (-0.2, 3.0, True)]
)
def test_a_stream_that_zooms_without_saying_so_is_told(focal, seconds, denied):
    """After 50 s of a right lens, in which all was learned; and nothing else is blamed."""
    wrong = Wrong(focal=focal, zoom_s=50.0, zooms_for_s=seconds)
    flown = Flown(wrong, square(62.0), (lambda t: t < 40.0) if denied else lambda _: True).fly()
    assert ever(flown) == {"focal"}
    assert 50.0 < flown.first(lambda f: "focal" in findings(f)) < 56.0
    assert flown.found[-1][1].focal.value == pytest.approx(focal, rel=0.35)


def test_a_zoom_in_a_hover_is_told_and_not_called_late_stamps() -> None:
    """Heights alone tell it there; who stands can tell nothing of stamps."""
    flown = Flown(Wrong(focal=0.1, zoom_s=50.0), square(80.0, hold=True)).fly()
    assert ever(flown) == {"focal"}
    assert flown.first(lambda f: "focal" in findings(f)) < 80.0


def test_a_shifted_map_and_a_biased_receiver_are_no_focal_length() -> None:
    """4 m apart in a turning flight: whoever is wrong, it is not the lens."""
    assert ever(Flown(Wrong(map_m=(3.0, 2.0), gnss_m=(0.0, 1.0)), SURVEYED).fly()) == set()


def test_where_nothing_can_be_told_nothing_is_said() -> None:
    """A hover without turns shows neither a focal length nor a delay."""
    still = square(30.0, leg_s=1e3, climb_s=0.0, hold=True)
    flown = Flown(Wrong(focal=0.05, late_s=0.3), still, lost).fly()
    assert ever(flown) == set()
    last = flown.found[-1][1]
    assert last.focal.sigma > 0.02
    assert last.late_s.sigma > 0.1


def test_what_contradicts_itself_is_not_told() -> None:
    """A gimbal that reports late turns late; the way over ground says that pictures are in time."""

    class Lagging(Flown):
        def gimbal_at(self, time_ns: int):  # type: ignore[no-untyped-def]
            return super().gimbal_at(time_ns - 200_000_000)

    assert "time" not in ever(Lagging(Wrong(), square(60.0, leg_s=10.0)).fly())


class Bolted(Flown):
    """A camera without a gimbal, under an autopilot whose own attitude lags by 180 ms."""

    def gimbal_at(self, time_ns: int) -> GimbalAttitude:
        return replace(super().gimbal_at(time_ns - 180_000_000), source="fixed")


@pytest.mark.parametrize("denied", [False, True])
def test_an_attitude_that_lags_is_no_time_of_a_bolted_camera(denied: bool) -> None:
    """The turns were sure of "-0.18 s" before the way over ground was sure of none, and it was told
    until then.
    """
    flown = Bolted(Wrong(), square(60.0, leg_s=10.0), lost if denied else lambda _: True).fly()
    assert "time" not in ever(flown)


@pytest.mark.parametrize("late_s", [0.2, -0.18])
def test_stamps_of_a_bolted_camera_that_are_off_are_still_told(late_s: float) -> None:
    class Prompt(Bolted):
        def gimbal_at(self, time_ns: int) -> GimbalAttitude:
            return super().gimbal_at(time_ns + 180_000_000)

    flown = Prompt(Wrong(late_s=late_s), square(40.0, leg_s=10.0), lost).fly()
    assert flown.first(lambda f: "time" in findings(f)) < 30.0
    assert flown.found[-1][1].late_s.value == pytest.approx(late_s, rel=0.2)


def test_an_ekf_that_late_positions_turned_away_is_no_camera_that_is_off() -> None:
    """`late-300ms` at 10 m/s on ArduPilot: on vision alone the EKF's heading went 5 degrees off in
    8 s, and the camera's yaw was blamed beside the stamps.
    """

    flown = Dragged(LATE, CORNERS, lambda at_s: at_s < 5.0).fly()
    assert ever(flown) == {"time"}


def test_an_ekf_that_is_not_where_the_receiver_is_bears_no_witness() -> None:
    """The receiver is well, but the EKF flies on vision, 12 m from it, whoever chose that: what it
    agrees with is itself.
    """

    class OnVision(Dragged):
        def gnss_place_at(self, time_ns: int) -> tuple[float, ...] | None:
            return self._sighting(time_ns * 1e-9).place

        def state(self) -> VehicleState:
            north, east, _ = self._sighting(self._at_s).place
            return replace(super().state(), latitude_deg=north, longitude_deg=east)

    assert ever(OnVision(replace(LATE, map_m=(12.0, 0.0)), CORNERS).fly()) == {"time"}


def test_pictures_that_come_again_are_forgotten() -> None:
    """A loop of 5 s from 40 s on, found 3.5 s later: until then other places were taken in."""

    class Looped(Flown):
        def _sighting(self, at_s: float) -> CalibrationObservation:
            if at_s < 40.0:
                return super()._sighting(at_s)
            if at_s >= 43.5:
                self.watch.exclude_since(40_000_000_000)
            shown = super()._sighting(35.0 + at_s % 5.0)
            return replace(shown, time_ns=round(at_s * 1e9))

    flown = Looped(Wrong(), square(60.0, leg_s=10.0), lambda at_s: at_s < 30.0).fly()
    last = flown.found[-1][1]
    before = next(figures for at_s, figures in flown.found if at_s >= 40.0)
    assert not set().union(*(findings(f) for at_s, f in flown.found if not 40.0 < at_s < 44.0))
    assert last.late_s.value == pytest.approx(before.late_s.value, abs=0.02)
    assert last.focal.value == pytest.approx(before.focal.value, abs=0.002)


@pytest.mark.parametrize("since_s", [18.0, 20.2])
def test_excluded_frames_do_not_bring_a_discarded_time_offset_back(since_s: float) -> None:
    """The excluded frames begin before, or just after, the time from which it is discarded."""
    sigmas = []

    class Doubted(Flown):
        def _sighting(self, at_s: float) -> CalibrationObservation:
            if at_s == 20.0:
                self.watch.suspect_timestamps(20_000_000_000)
            if at_s == 23.0:
                self.watch.exclude_since(round(since_s * 1e9))
                sigmas.append(self.watch.figures().late_s.sigma)
            return super()._sighting(at_s)

    flown = Doubted(Wrong(), square(60.0, climb_s=0.0), lost).fly()
    before = next(figures for at_s, figures in flown.found if at_s >= 19.0)
    assert before.late_s.sigma < 0.1
    assert sigmas == pytest.approx([0.15], rel=0.05)  # as at a start
