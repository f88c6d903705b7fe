from dataclasses import replace

import numpy as np
import pytest

from companion.reporting.content import advice, value_and_limit
from localizer.evaluation.sequences import LocalizationMetrics
from localizer.geometry.pose import Pose, quaternion_from_matrix, so3_exp
from sitl.demo.analysis import (
    Spread,
    bound_figures,
    ekf_errors,
    frame_errors,
    localization_summary,
    stage_latencies,
    target_errors,
    targets_inside,
)
from sitl.demo.report import ComputingRates, FlightFigures, check_criteria, headline

GOOD = LocalizationMetrics(100, 0.2, 0.2, 90.0, 100.0, 100.0, 100.0, 9.0)


def _judged(localizer=None, ekf=0.5, fixed=1.0, inside=96.0, level=100.0, targets=99.0):
    metrics = replace(GOOD, **(localizer or {}))
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


# --- analysis -----------------------------------------------------------------------------------


def _columns(poses, times, **more):
    q = np.array([quaternion_from_matrix(p.rotation) for p in poses]).reshape(-1, 4)
    t = np.array([p.translation for p in poses]).reshape(-1, 3)
    names = ("east_m", "north_m", "up_m", "qw", "qx", "qy", "qz")
    return {
        "exposure_time_ns": np.array(times, dtype=np.int64),
        **dict(zip(names, np.hstack([t, q]).T, strict=True)),
        **more,
    }


def _pose(x, angle=0.0, up=0.0):
    return Pose(so3_exp([0, 0, angle]), np.array([x, 0.0, up]))


def test_frames_are_matched_by_time_and_measured():
    truth = _columns([_pose(0.0), _pose(1.0), _pose(2.0), _pose(3.0)], [0, 10**8, 2 * 10**8, 3e8])
    estimates = _columns(
        [_pose(0.3, up=0.4), _pose(2.0, 0.1), _pose(9.0)], [0, 2 * 10**8, 3 * 10**8],
        accepted=np.array([1, 1, 0]),
    )  # fmt: skip
    errors = frame_errors(truth, estimates, (0, 10**9))
    np.testing.assert_array_equal(errors.processed, [True, False, True, True])
    np.testing.assert_allclose(errors.translation_m, [0.5, np.nan, 0.0, np.nan], atol=1e-9)
    np.testing.assert_allclose(errors.horizontal_m, [0.3, np.nan, 0.0, np.nan], atol=1e-9)
    assert errors.rotation_deg[2] == pytest.approx(np.degrees(0.1))
    summary = localization_summary(errors)
    assert summary.frames == 3
    assert summary.completeness == pytest.approx(200 / 3)
    assert summary.fps == pytest.approx(2 / 0.3)


def test_frames_outside_the_span_do_not_count():
    truth = _columns([_pose(0.0), _pose(1.0)], [0, 10**9])
    estimates = _columns([_pose(0.0), _pose(1.0)], [0, 10**9], accepted=np.array([1, 1]))
    assert len(frame_errors(truth, estimates, (5, 2 * 10**9)).time_ns) == 1


def test_fixes_are_counted_against_their_bound_and_their_protection_level():
    times = [k * 10**8 for k in range(5)]
    truth = _columns([_pose(0.0)] * 5, times)
    wrong_m = [0.5, 1.0, 3.0, 9.0, 9.0]  # 2.45 sigmas are the ellipse; the last is not accepted
    estimates = _columns(
        [_pose(x) for x in wrong_m], times, accepted=np.array([1, 1, 1, 1, 0]),
        sigma_east_m=np.full(5, 1.0), sigma_north_m=np.full(5, 1.0),
        hpl_m=np.array([2.0, 2.0, 4.0, 4.0, 1.0]),
    )  # fmt: skip
    found = bound_figures(truth, estimates, (0, 10**9))
    assert (found.inside_bound, found.inside_level) == (50.0, 75.0)
    assert found.level_m.median == 3.0
    assert bound_figures(truth, {}, (0, 10**9)).inside_level is None


def test_ekf_target_and_stage_errors():
    vehicle = {"time_ns": np.array([0, 1, 2])}
    for axis, offset in (("east", 3.0), ("north", 4.0), ("up", -1.0)):
        vehicle[f"{axis}_m"] = np.zeros(3)
        vehicle[f"ekf_{axis}_m"] = np.full(3, offset)
    np.testing.assert_allclose(ekf_errors(vehicle, (1, 2)), [5.0, 5.0])
    targets = {
        "target_id": np.array(["a", "b", "a"]), "exposure_time_ns": np.array([1, 1, 7]),
        "east_m": np.array([1.0, 0.0, 0.0]), "north_m": np.zeros(3), "up_m": np.zeros(3),
        "cov_ee": np.full(3, 0.1), "cov_en": np.zeros(3), "cov_nn": np.ones(3),
    }  # fmt: skip
    truth = {"a": {1: np.zeros(3)}, "b": {1: np.zeros(3)}}
    np.testing.assert_allclose(target_errors(targets, truth, (0, 5))["a"], [1.0])
    assert targets_inside(targets, truth, (0, 5)) == 50.0  # 1 m at a sigma of 0.32 m is outside
    assert targets_inside(targets, {}, (0, 5)) is None
    assert [len(e) for e in target_errors({}, truth, (0, 5)).values()] == [0, 0]
    assert targets_inside({}, truth, (0, 5)) is None
    stages = stage_latencies({"exposure_time_ns": np.array([0, 9]), "x_ms": np.array([4.0, 8.0])},
                             (0, 5))  # fmt: skip
    assert stages["x"].median == 4.0
