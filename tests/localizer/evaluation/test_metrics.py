import numpy as np
import pytest

from localizer.evaluation.metrics import localization_metrics


def test_recall_needs_both_errors_within_and_counts_missing_frames_as_failed():
    translation = np.array([0.5, 0.5, 2.0, np.nan])
    rotation = np.array([0.5, 2.0, 0.1, np.nan])
    m = localization_metrics(translation, rotation, seconds=2.0)
    assert (m.recall_1, m.recall_3, m.recall_5) == (25.0, 75.0, 75.0)
    assert m.completeness == 75.0
    assert m.median_translation_m == 0.5
    assert m.p95_translation_m == pytest.approx(1.85)  # of 0.5, 0.5, 2.0
    assert (m.max_translation_m, m.max_rotation_deg) == (2.0, 2.0)
    assert m.fps == 2.0


def test_no_estimate_at_all_is_not_a_perfect_score():
    m = localization_metrics(np.full(3, np.nan), np.full(3, np.nan), 1.0)
    assert m.completeness == 0.0
    assert m.median_translation_m is None
    assert m.max_rotation_deg is None
    assert m.p95_translation_m is None


def test_no_frames():
    m = localization_metrics(np.array([]), np.array([]), 0.0)
    assert m.recall_5 == pytest.approx(0.0)
