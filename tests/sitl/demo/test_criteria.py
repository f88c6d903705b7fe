from dataclasses import asdict

import pytest

from companion.reporting.verdicts import advice, value_and_limit
from localizer.evaluation.metrics import LocalizationMetrics
from sitl.demo.analysis import Spread
from sitl.demo.criteria import ComputingRates, FlightFigures, check_criteria, headline

GOOD = LocalizationMetrics(100, 0.2, 0.2, 90.0, 100.0, 100.0, 100.0, 9.0)


def _judged(localizer=None, ekf=0.5, fixed=1.0, inside=96.0, level=100.0, targets=99.0):
    metrics = LocalizationMetrics(**(asdict(GOOD) | (localizer or {})))
    return FlightFigures(
        metrics, Spread(0.1, ekf, 9.0), Spread(0.1, fixed, 9.0), inside, level, targets
    )


def _missed(**changes):
    return [c.name for c in check_criteria(_judged(**changes)) if not c.ok]


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, []),
        ({"localizer": {"median_translation_m": 0.26}}, ["localizer median"]),
        ({"localizer": {"recall_3": 99.9}}, ["localizer R@3"]),
        ({"localizer": {"completeness": 98.9}}, ["completeness"]),
        ({"localizer": {"fps": 7.9}}, ["localized frames"]),
        ({"ekf": 0.61}, ["EKF horizontal p95"]),
        ({"fixed": 3.01}, ["fixed targets p95"]),
        ({"fixed": None}, ["fixed targets p95"]),
        ({"inside": 94.9}, ["fixes in their bound"]),
        ({"inside": None}, ["fixes in their bound"]),
        ({"level": 99.8}, ["fixes in their level"]),
        ({"level": None}, ["fixes in their level"]),
    ],
)
def test_each_target_is_missed_for_its_own_reason(changes, missed):
    assert _missed(**changes) == missed


def test_what_was_won_is_said_first_and_with_its_figures():
    text = headline(_judged(), home_error_m=0.51, denied_s=162.0)
    assert text.startswith("came home on vision alone after 162 s, 0.5 m from home")
    assert "EKF p95 0.50 m" in text
    assert "0.20 m in the median, 100.0 % of frames" in text


@pytest.mark.parametrize(
    ("value", "limit", "at_least", "shown"),
    [
        (0.253, 0.25, False, "0.253 m"),
        (0.2500001, 0.25, False, "0.2500001 m"),
        (99.996, 100.0, True, "99.996 m"),
        (0.247, 0.25, False, "0.25 m"),
        (0.25, 0.25, False, "0.25 m"),
        (99.94, 100.0, True, "99.94 m"),
        (None, 1.0, False, "-"),
        (float("nan"), 1.0, False, "-"),
    ],
)
def test_what_was_missed_is_seen_in_its_digits(value, limit, at_least, shown):
    found, needed = value_and_limit(value, limit, "m", at_least=at_least)
    assert found == shown
    assert needed == f"{'>=' if at_least else '<='} {limit:g} m"


GOOD_PACE = {"sent_hz": 10.0, "wanted_hz": 10, "taken": 1.0, "latency_ms": 150.0,
             "delay_ms": 220.0, "load": 1.5}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sent_hz": 6.1}, "the camera sent 6.1 of 10 pictures/s"),
        ({"taken": 0.5}, "50 % of the pictures were localized in time"),
        ({"latency_ms": 612.0}, "exposure to estimate p95 612 ms (220 at most)"),
        ({"latency_ms": 260.0, "delay_ms": 300.0}, "exposure to estimate p95 260 ms (250 at most)"),
    ],
)
def test_a_computer_that_is_too_slow_is_named_and_what_it_did_not_keep_up_with(changes, said):
    text = ComputingRates(**(GOOD_PACE | changes)).slow_reason()
    assert text is not None
    assert said in text
    assert "did not keep up" in text


@pytest.mark.parametrize("changes", [{}, {"latency_ms": None}, {"sent_hz": 9.6, "taken": 0.97}])
def test_a_computer_that_keeps_up_is_not_blamed(changes):
    assert ComputingRates(**(GOOD_PACE | changes)).slow_reason() is None


def test_every_target_says_what_a_miss_means_and_where_to_look():
    names = {c.name for map_ in (True, False) for c in check_criteria(_judged(), satellite=map_)}
    known = [advice(name) for name in names]
    assert advice("something else") not in known
    assert len({a.look for a in known}) == len(known)


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({"ekf": 2.9, "fixed": 14.0, "inside": 93.1}, []),
        ({"ekf": 3.1}, ["EKF horizontal p95"]),
        ({"inside": 92.9}, ["fixes in their bound"]),
        ({"targets": 94.0}, ["fixed targets in their bound"]),
        ({"targets": None}, ["fixed targets in their bound"]),
    ],
)
def test_a_flight_over_a_satellite_map_needs_claims_that_hold(changes, missed):
    found = check_criteria(_judged(**changes), satellite=True)
    assert [c.name for c in found if not c.ok] == missed
