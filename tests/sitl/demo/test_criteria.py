import pytest

from localizer.evaluation.metrics import LocalizationMetrics
from sitl.demo.analysis import Spread
from sitl.demo.criteria import Judged, headline, judge, latency_warning

GOOD = LocalizationMetrics(100, 0.2, 0.2, 90.0, 100.0, 100.0, 100.0, 9.0)


def _judged(localizer=None, ekf=0.5, fixed=1.0, inside=96.0):
    metrics = LocalizationMetrics(**(GOOD.to_dict() | (localizer or {})))
    return Judged(metrics, Spread(0.1, ekf, 9.0), Spread(0.1, fixed, 9.0), inside)


def _missed(**changes):
    return [c.name for c in judge(_judged(**changes)) if not c.ok]


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
    ],
)
def test_each_target_is_missed_for_its_own_reason(changes, missed):
    assert _missed(**changes) == missed


@pytest.mark.parametrize(
    ("p95", "delay", "warns"),
    [(199, 200, False), (201, 200, True), (249, 300, False), (251, 300, True)],
)
def test_late_estimates_are_told_against_the_delay_and_the_filters_limit(p95, delay, warns):
    text = latency_warning(Spread(100.0, p95, 900.0), delay)
    assert (text is not None) is warns
    if text is not None:
        assert f"{p95} ms" in text
        assert f"delay_ms {delay}" in text


def test_what_was_won_is_said_first_and_with_its_figures():
    text = headline(_judged(), home_error_m=0.51, denied_s=162.0)
    assert text.startswith("came home on vision alone after 162 s, 0.5 m from home")
    assert "EKF p95 0.50 m" in text
    assert "0.20 m in the median, 100.0 % of frames" in text
