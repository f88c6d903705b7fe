"""What it costs in accuracy that a reference view serves more than one frame: paired, per frame."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np

from localizer.config import LocalizerConfig
from localizer.evaluation.sequences import Perturbation
from localizer.evaluation.sequences import Sequence as Recorded
from localizer.geometry.pose import Array
from localizer.tracking.opening import MapStack, build_localizer

_BLOCK = 20  # frames that err alike
_DRAWS = 2000


def shift_errors(
    stack: MapStack, sequence: Recorded, config: LocalizerConfig
) -> tuple[Array, Array, float]:
    """Position errors (F,) in metres and rotation errors in degrees, NaN where none was accepted;
    mean milliseconds of processor a frame.
    """
    localizer = build_localizer(stack, sequence.camera, config)
    errors = np.full((2, len(sequence.images)), np.nan)
    began = 0.0
    for index in range(len(sequence.images)):
        frame = sequence.frame(index)
        if index == 0:
            prior = Perturbation(5.0, 5.0).prior(sequence.truth[0], 0, frame.exposure_time_ns)
            localizer.set_prior(prior)
        at = time.process_time()
        estimate = localizer.track(frame, passes=1 if index else 3)
        began += time.process_time() - at if index else 0.0
        if estimate.accepted:
            errors[:, index] = sequence.truth[index].distance_to(estimate.world_from_camera)
    return errors[0], errors[1], 1e3 * began / max(len(sequence.images) - 1, 1)


def paired(
    stack: MapStack, sequence: Recorded, config: LocalizerConfig, shifts: Sequence[float]
) -> Iterator[dict[str, object]]:
    """For each limit: medians, and its errors less those of a reference for every frame."""
    base: tuple[Array, Array] | None = None
    for shift in (0.0, *(s for s in shifts if s)):
        changed = config.model_copy(update={"reference_shift_px": shift})
        metres, degrees, cpu_ms = shift_errors(stack, sequence, changed)
        base = base or (metres, degrees)
        low, high = _interval(metres - base[0])
        yield {
            "reference_shift_px": shift, "frames": len(metres), "cpu_ms_per_frame": cpu_ms,
            "completeness_percent": 100 * float(np.isfinite(metres).mean()),
            "median_m": float(np.nanmedian(metres)), "p95_m": float(np.nanpercentile(metres, 95)),
            "max_m": float(np.nanmax(metres)), "median_deg": float(np.nanmedian(degrees)),
            "change_m": float(np.nanmean(metres - base[0])), "change_interval_m": [low, high],
        }  # fmt: skip


def _interval(change: Array) -> tuple[float, float]:
    """95 % interval of the mean change, bootstrap over blocks of neighbouring frames."""
    blocks = [change[k : k + _BLOCK] for k in range(0, len(change), _BLOCK)]
    rng = np.random.default_rng(0)
    means = [
        np.nanmean(np.concatenate([blocks[k] for k in rng.integers(0, len(blocks), len(blocks))]))
        for _ in range(_DRAWS)
    ]
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)
