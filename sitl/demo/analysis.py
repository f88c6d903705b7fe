"""Computes the errors of a flight from its records: pure functions over arrays read from CSV."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from companion.offline.record import Columns, poses
from companion.reporting.figures import nearest
from localizer.evaluation.sequences import LocalizationMetrics, localization_metrics
from localizer.geometry.pose import Array

_CHI2_95 = 5.991  # of two degrees of freedom


@dataclass(frozen=True)
class FrameErrors:
    """Pose errors of every frame exposed in a time span; arrays (F,), NaN without an accepted
    estimate.

    translation_m: 3-D; horizontal_m: comparable with the EKF's. processed: whether the localizer
    processed the frame; False if it dropped the frame for a newer one.
    """

    time_ns: np.ndarray
    translation_m: Array
    horizontal_m: Array
    rotation_deg: Array
    processed: np.ndarray


def frame_errors(truth: Columns, estimates: Columns, span_ns: tuple[int, int]) -> FrameErrors:
    """Errors of pose estimates against true camera poses, matched by exposure time. span_ns: first
    and last exposure.
    """
    inside = (truth["exposure_time_ns"] >= span_ns[0]) & (truth["exposure_time_ns"] <= span_ns[1])
    times = truth["exposure_time_ns"][inside]
    true_poses = [p for p, keep in zip(poses(truth), inside, strict=True) if keep]
    translation, horizontal, rotation = (np.full(len(times), np.nan) for _ in range(3))
    found = np.full(len(times), -1)
    if estimates:
        order = np.argsort(estimates["exposure_time_ns"])
        found = nearest(np.asarray(estimates["exposure_time_ns"])[order], times)
        estimated, accepted = poses(estimates), np.asarray(estimates["accepted"]) > 0
        for i in np.flatnonzero(found >= 0):
            k = order[found[i]]
            if accepted[k]:
                translation[i], rotation[i] = true_poses[i].distance_to(estimated[k])
                off = estimated[k].translation - true_poses[i].translation
                horizontal[i] = np.hypot(*off[:2])
    return FrameErrors(times, translation, horizontal, rotation, found >= 0)


def localization_summary(errors: FrameErrors) -> LocalizationMetrics:
    """Summarize the errors of the processed frames in the columns of the PiLoT paper.

    fps: localized frames per second of flight, not the throughput of the computer.
    """
    done = errors.processed
    localized = int(np.isfinite(errors.translation_m).sum())
    span_s = max(float(errors.time_ns[-1] - errors.time_ns[0]) * 1e-9, 1e-9) if len(done) else 1.0
    metrics = localization_metrics(errors.translation_m[done], errors.rotation_deg[done], 1.0)
    values = metrics.__dict__ | {"fps": localized / span_s}
    return LocalizationMetrics(**values)


@dataclass(frozen=True)
class Spread:
    """Median, 95th percentile and maximum of an error; None where nothing was measured."""

    median: float | None
    p95: float | None
    maximum: float | None

    @classmethod
    def of(cls, values: Array) -> Spread:
        """Computed from the finite values."""
        finite = np.asarray(values)[np.isfinite(values)]
        if not len(finite):
            return cls(None, None, None)
        return cls(*(float(x) for x in (*np.percentile(finite, [50, 95]), finite.max())))


def ekf_errors(
    vehicle: Columns, span_ns: tuple[int, int], shift_m: tuple[float, float, float] = (0, 0, 0)
) -> Array:
    """Horizontal errors (N,) m of the EKF position against the truth. shift_m: offset of the map
    from the world (east, north, up), added to the truth.
    """
    t = vehicle["time_ns"]
    inside = (t >= span_ns[0]) & (t <= span_ns[1])
    east, north = (
        vehicle[f"ekf_{a}_m"][inside] - vehicle[f"{a}_m"][inside] - s
        for a, s in zip(("east", "north"), shift_m[:2], strict=True)
    )
    return np.asarray(np.hypot(east, north))


@dataclass(frozen=True)
class BoundFigures:
    """How often fixes were within their stated bounds, per cent. inside_bound: within their 95 %
    ellipse; inside_level: within their protection level; None: not known. level_m: the protection
    levels.
    """

    inside_bound: float | None
    inside_level: float | None
    level_m: Spread


def bound_figures(truth: Columns, estimates: Columns, span_ns: tuple[int, int]) -> BoundFigures:
    """Check the horizontal errors of the accepted estimates in a time span against their stated
    bounds: the 95 % ellipse of the reported sigmas, and the protection level.

    truth: map ENU, m, matched by exposure time. The figures are None without estimates.
    """
    rows, found = _matched(truth, estimates, span_ns)
    if not len(rows):
        return BoundFigures(None, None, Spread(None, None, None))
    errors = [estimates[f"{a}_m"][rows] - truth[f"{a}_m"][found] for a in ("east", "north")]
    scaled = [
        e / estimates[f"sigma_{a}_m"][rows] for e, a in zip(errors, ("east", "north"), strict=True)
    ]
    within = 100.0 * float((scaled[0] ** 2 + scaled[1] ** 2 <= _CHI2_95).mean())
    level = np.asarray(estimates["hpl_m"], float)[rows]
    known = np.isfinite(level)
    held = (np.hypot(*errors) <= level)[known]
    inside_level = 100.0 * float(held.mean()) if len(held) else None
    return BoundFigures(within, inside_level, Spread.of(level))


def _matched(
    truth: Columns, estimates: Columns, span_ns: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of accepted estimates in the span, and of the truth at their exposure."""
    if not estimates:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    times = np.asarray(estimates["exposure_time_ns"])
    inside = (times >= span_ns[0]) & (times <= span_ns[1])
    rows = np.flatnonzero((np.asarray(estimates["accepted"]) > 0) & inside)
    found = nearest(np.asarray(truth["exposure_time_ns"]), times[rows])
    return rows[found >= 0], found[found >= 0]


TruthAt = Mapping[str, Mapping[int, Array]]
"""True place (3,) ENU by a target's name and the time of a fix, ns."""


def target_errors(
    targets: Columns, truth_at: TruthAt, span_ns: tuple[int, int]
) -> dict[str, Array]:
    """3-D errors of each target's fixes within the span, m."""
    return {
        name: np.linalg.norm(_target_offsets(targets, name, truth, span_ns)[1], axis=1)
        for name, truth in truth_at.items()
    }


def targets_inside(targets: Columns, truth_at: TruthAt, span_ns: tuple[int, int]) -> float | None:
    """Per cent of target positions within their horizontal 95 % ellipse; None without targets."""
    squared = []
    for name, truth in truth_at.items():
        rows, offsets = _target_offsets(targets, name, truth, span_ns)
        if not len(rows):
            continue
        ee, en, nn = (targets[f"cov_{axes}"][rows] for axes in ("ee", "en", "nn"))
        e, n = offsets[:, 0], offsets[:, 1]
        squared.append((nn * e**2 - 2.0 * en * e * n + ee * n**2) / (ee * nn - en**2))
    inside = np.concatenate([*squared, np.empty(0)]) <= _CHI2_95
    return 100.0 * float(inside.mean()) if len(inside) else None


def _target_offsets(
    targets: Columns, name: str, truth: Mapping[int, Array], span_ns: tuple[int, int]
) -> tuple[np.ndarray, Array]:
    """Rows of a target's fixes in the span whose truth is known, and their errors (N, 3), ENU."""
    if not targets:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    times = targets["exposure_time_ns"]
    rows = np.array(
        [
            k
            for k in np.flatnonzero(
                (targets["target_id"] == name) & (times >= span_ns[0]) & (times <= span_ns[1])
            )
            if int(times[k]) in truth
        ],
        dtype=np.int64,
    )
    fixes = np.column_stack([targets[k][rows] for k in ("east_m", "north_m", "up_m")])
    true = np.array([truth[int(times[k])] for k in rows]).reshape(-1, 3)
    return rows, fixes - true


def stage_latencies(estimates: Columns, span_ns: tuple[int, int]) -> dict[str, Spread]:
    """Latency of each processing stage within a time span, ms."""
    t = estimates["exposure_time_ns"]
    inside = (t >= span_ns[0]) & (t <= span_ns[1])
    names = [k for k in estimates if k.endswith("_ms")]
    return {name.removesuffix("_ms"): Spread.of(estimates[name][inside]) for name in names}
