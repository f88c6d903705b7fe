import pytest

from localizer.evaluation.metrics import LocalizationMetrics
from sitl.demo.analysis import Spread
from sitl.demo.criteria import judge, latency_warning

GOOD = LocalizationMetrics(100, 0.4, 0.2, 90.0, 99.0, 100.0, 100.0, 9.0)


def _missed(localizer=None, ekf=1.0, fixed=1.0):
    metrics = LocalizationMetrics(**(GOOD.to_dict() | (localizer or {})))
    spreads = (Spread(0.1, p95, 9.0) for p95 in (ekf, fixed))
    return [c.name for c in judge(metrics, *spreads) if not c.ok]


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, []),
        ({"localizer": {"median_translation_m": 1.01}}, ["localizer median"]),
        ({"localizer": {"recall_3": 94.9}}, ["localizer R@3"]),
        ({"localizer": {"completeness": 98.9}}, ["completeness"]),
        ({"localizer": {"fps": 7.9}}, ["localized frames"]),
        ({"ekf": 3.01}, ["EKF horizontal p95"]),
        ({"fixed": 3.01}, ["fixed targets p95"]),
        ({"fixed": None}, ["fixed targets p95"]),
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
