"""A map that lies beside GNSS: found, told once, applied without a jump; noise alone is none."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from companion.calibration_watch.map_offset import MapOffsetEstimator, Policy
from companion.integrity_monitor.position_checks import GnssCheck
from localizer.types import PoseEstimate, TrackingState
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.messages import VehicleState, VisionFix
from mavlink_bridge.vehicle.origin import north_east, offset

HOME = (47.397742, 8.545594)
HZ = 10
SECOND = 10**9
LATENCY_NS = 150_000_000  # from the exposure to the judgement
REPORT_NS, REPORTED_NS = 200_000_000, 70_000_000  # GLOBAL_POSITION_INT at 5 Hz, the first of them


@dataclass
class Flight:
    """Circles for a while; GNSS has a bias, an error that wanders, and noise. It is lost at
    `lost_s`. As the bridge's, its places are known up to the vehicle's newest report.
    """

    shift: tuple[float, float]
    seed: int = 0
    bias_m: float = 0.3
    lost_s: float = 1e9
    said: list[Alert] = field(default_factory=list)
    fixes: list[VisionFix] = field(default_factory=list)
    _now: int = 0
    _clock_ns: int = 0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self._rng, self._bias = rng, rng.normal(0, self.bias_m, 2)
        self._wander = np.zeros(2)

    def true(self, k: int) -> tuple[float, float]:
        return 100.0 * np.cos(0.08 * k / HZ), 100.0 * np.sin(0.08 * k / HZ)

    def state(self) -> VehicleState:
        return VehicleState(connected=True, gps_fix_type=3, gps_h_accuracy_m=0.8)

    def gnss_place_at(self, time_ns: int) -> tuple[float, ...] | None:
        k = round(time_ns * 1e-9 * HZ)
        newest_ns = (self._clock_ns - REPORTED_NS) // REPORT_NS * REPORT_NS + REPORTED_NS
        if k / HZ >= self.lost_s or time_ns > newest_ns:
            return None
        keep = 1.0 - 1.0 / (30.0 * HZ)  # half a minute
        self._wander = keep * self._wander + self._rng.normal(0, 0.3 * np.sqrt(2 / 300), 2)
        north, east = np.array(self.true(k)) + self._bias + self._wander
        north, east = np.array([north, east]) + self._rng.normal(0, 0.2, 2)
        return (*offset(*HOME, north, east), 500.0)

    def report_alert(self, alert: Alert) -> None:
        self.said.append(alert)

    def fly(self, judge: MapOffsetEstimator, seconds: float, *, applies: bool = True) -> None:
        seen = PoseEstimate.__new__(PoseEstimate)
        object.__setattr__(seen, "state", TrackingState.TRACKING)
        for k in range(self._now, self._now + round(seconds * HZ)):
            place = np.array(self.true(k)) + self.shift + self._rng.normal(0, 0.1, 2)
            fix = VisionFix(k * SECOND // HZ, *offset(*HOME, *place), 550.0)
            self._clock_ns = fix.time_ns + LATENCY_NS
            self.fixes.append(judge.corrected(fix) if applies else fix)
            judge.add_fix(seen, fix)
        self._now += round(seconds * HZ)

    def error(self, k: int) -> float:
        """Of what is injected, metres from the truth."""
        fix = self.fixes[k]
        here = north_east(*HOME, fix.latitude_deg, fix.longitude_deg)
        return float(np.hypot(*(np.array(here) - self.true(k))))


def judge(flight: Flight, policy: Policy = "tell") -> MapOffsetEstimator:
    return MapOffsetEstimator(flight, policy, lambda *_: None)


def test_a_shifted_map_is_told_once_and_changes_nothing() -> None:
    flight = Flight((0.1, 3.4))
    shift = judge(flight)
    flight.fly(shift, 240, applies=False)
    assert len(flight.said) == 1
    assert flight.said[0].values[0] == pytest.approx(3.4, abs=0.5)
    assert flight.said[0].values[1:] == ("east", "")
    assert shift.shift.ne_m == pytest.approx((0.1, 3.4), abs=1.0)
    assert flight.error(2000) == pytest.approx(3.4, abs=0.5)
    report = shift.report()
    assert report is not None
    assert report["applied_east_m"] == 0.0


def test_an_applied_shift_creeps_in_stays_after_gnss_and_is_what_others_compare() -> None:
    flight = Flight((-2.8, -2.8), lost_s=200)
    shift = judge(flight, "apply")
    flight.fly(shift, 400)
    assert len(flight.said) == 1
    assert flight.said[0].values[1:] == ("south-west", ", applied")
    assert flight.error(500) == pytest.approx(3.96, abs=0.5)  # not known yet
    assert flight.error(3900) < 1.2  # GNSS's own bias remains
    places = np.array([north_east(*HOME, f.latitude_deg, f.longitude_deg) for f in flight.fixes])
    truth = np.array([flight.true(k) for k in range(len(places))])
    creep = np.diff((places - truth)[::HZ], axis=0)
    assert np.linalg.norm(creep, axis=1).max() < 0.2 + 0.6  # a second's creep, and noise
    grown = flight.fixes[-1].position_covariance_ned[0, 0]
    assert grown > flight.fixes[0].position_covariance_ned[0, 0] + 0.25
    latitude, longitude = offset(*HOME, *flight.true(3900))
    state = VehicleState(
        connected=True, gps_fix_type=3, gps_latitude_deg=latitude, gps_longitude_deg=longitude,
        gps_h_accuracy_m=0.5, gps_time_ns=flight.fixes[3900].time_ns,
    )  # fmt: skip
    apart = GnssCheck().read(flight.fixes[3900], state, 0.0, state.gps_time_ns)
    assert apart.figure < 1.2


@pytest.mark.parametrize("bias_m", [0.3, 0.55])
def test_gnss_errors_alone_are_no_shift(bias_m: float) -> None:
    told = 0
    for seed in range(20):
        flight = Flight((0.0, 0.0), seed=seed, bias_m=bias_m)
        shift = judge(flight, "apply")
        flight.fly(shift, 100)
        told += len(flight.said)
        report = shift.report()
        assert report is None or not report["applied_north_m"] or flight.said
    assert told == 0


def test_another_place_is_no_shift() -> None:
    flight = Flight((60.0, 0.0))
    flight.fly(judge(flight, "apply"), 120)
    assert flight.said == []
    assert flight.error(1100) == pytest.approx(60.0, abs=1.0)


def test_our_own_gps_input_teaches_nothing() -> None:
    flight = Flight((5.0, 0.0))
    shift = MapOffsetEstimator(flight, "apply", lambda *_: None, gnss_is_ours=True)
    flight.fly(shift, 90)
    assert shift.shift is None
    assert shift.report() is None
