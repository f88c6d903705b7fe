"""The paper's measures of localization (Sec. 4.2, Table 2): pure functions over error arrays."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from localizer.geometry.pose import Array


@dataclass(frozen=True)
class LocalizationMetrics:
    """One row of the paper's Table 2. Recalls and completeness in per cent of all frames."""

    frames: int
    median_translation_m: float
    median_rotation_deg: float
    recall_1: float
    recall_3: float
    recall_5: float
    completeness: float
    fps: float

    def to_dict(self) -> dict[str, float | int | None]:
        """JSON-ready; a median over no frame is null."""
        return {k: None if np.isnan(v) else v for k, v in asdict(self).items()}


def localization_metrics(
    translation_m: Array, rotation_deg: Array, seconds: float
) -> LocalizationMetrics:
    """Metrics of per-frame errors (F,); NaN marks a frame without an estimate.

    Medians are over the localized frames; a recall counts a frame when both errors are within its
    number of metres and degrees; a frame without an estimate counts as failed.
    """
    frames = len(translation_m)
    found = np.isfinite(translation_m) & np.isfinite(rotation_deg)

    def recall(limit: float) -> float:
        within = found & (translation_m <= limit) & (rotation_deg <= limit)
        return _percent(int(np.count_nonzero(within)), frames)

    return LocalizationMetrics(
        frames=frames,
        median_translation_m=_median(translation_m[found]),
        median_rotation_deg=_median(rotation_deg[found]),
        recall_1=recall(1.0),
        recall_3=recall(3.0),
        recall_5=recall(5.0),
        completeness=_percent(int(np.count_nonzero(found)), frames),
        fps=frames / seconds if seconds > 0 else 0.0,
    )


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else 0.0
