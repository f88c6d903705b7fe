"""The paper's error measures of localization (Sec. 4.2, Table 2) over error arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array


@dataclass(frozen=True)
class LocalizationMetrics:
    """One row of the paper's Table 2. Recalls and completeness in per cent of all frames.

    Medians, 95th percentiles and maxima are over the localized frames; None if there is none.
    """

    frames: int
    median_translation_m: float | None
    median_rotation_deg: float | None
    recall_1: float
    recall_3: float
    recall_5: float
    completeness: float
    fps: float
    p95_translation_m: float | None = None
    p95_rotation_deg: float | None = None
    max_translation_m: float | None = None
    max_rotation_deg: float | None = None


def localization_metrics(
    translation_m: Array, rotation_deg: Array, seconds: float
) -> LocalizationMetrics:
    """Metrics of per-frame errors (F,); NaN marks a frame without an estimate.

    Medians are over the localized frames; a recall counts a frame when both errors are within its
    number of metres and degrees; a frame without an estimate counts as failed. seconds: wall time
    of the run.
    """
    frames = len(translation_m)
    found = np.isfinite(translation_m) & np.isfinite(rotation_deg)

    def recall(limit: float) -> float:
        within = found & (translation_m <= limit) & (rotation_deg <= limit)
        return _percent(int(np.count_nonzero(within)), frames)

    return LocalizationMetrics(
        frames=frames,
        median_translation_m=_percentile(translation_m[found], 50),
        median_rotation_deg=_percentile(rotation_deg[found], 50),
        recall_1=recall(1.0),
        recall_3=recall(3.0),
        recall_5=recall(5.0),
        completeness=_percent(int(np.count_nonzero(found)), frames),
        fps=frames / seconds if seconds > 0 else 0.0,
        p95_translation_m=_percentile(translation_m[found], 95),
        p95_rotation_deg=_percentile(rotation_deg[found], 95),
        max_translation_m=_percentile(translation_m[found], 100),
        max_rotation_deg=_percentile(rotation_deg[found], 100),
    )


def _percentile(values: Array, percent: float) -> float | None:
    if not len(values):
        return None
    # Of an even number of values np.percentile rounds differently than the mean of the two.
    return float(np.median(values) if percent == 50 else np.percentile(values, percent))


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else 0.0
