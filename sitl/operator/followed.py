"""Evaluates a target track: kept to the end, on the right car, and reacquired after each roof."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from sitl.operator.chase import Chase

_LAST_S = 2.0  # before the end: it must still be seen then
_OFF_M = 4.0  # what is farther from the car's middle is no report of it
_BACK_S = 2.5  # after a roof it must be seen again so soon
_SETTLED_S = 3.0  # after the click its motion is measured


@dataclass(frozen=True)
class FollowedFix:
    """One reported target position (3,) m, map ENU, with covariance and velocity (3,) m/s or None.
    is_seen: detected in its frame, not predicted.
    """

    time_ns: int
    position: Array
    covariance: Array
    velocity: Array | None
    is_seen: bool


@dataclass(frozen=True)
class FollowVerdict:
    """Result of a target track. Errors: horizontal, of detected positions after settling. seen:
    detected positions among `reports`. back_s: time to reacquire after each roof. foreign:
    positions farther than 4 m from the car. inside_percent: within their 95 % ellipse. why: reasons
    for a failure.
    """

    is_followed: bool
    reports: int
    seen: int
    back_s: tuple[float, ...]
    foreign: int
    p50_m: float
    p95_m: float
    max_m: float
    inside_percent: float
    velocity_p95_mps: float
    why: tuple[str, ...] = ()
    errors_m: tuple[float, ...] = ()
    times_s: tuple[float, ...] = ()


_CHI2_95 = 5.991  # of two degrees of freedom


def follow_verdict(fixes: Sequence[FollowedFix], chase: Chase, end_ns: int) -> FollowVerdict:
    """Compare one target's positions with the true car, from the click until `end_ns`."""
    begin_ns = chase.begins_ns()
    off = np.array([(f.position - chase.car.position_at(f.time_ns))[:2] for f in fixes])
    off = off.reshape(-1, 2)
    errors = np.linalg.norm(off, axis=1)
    times = np.array([(f.time_ns - begin_ns) * 1e-9 for f in fixes])
    seen = np.array([f.is_seen for f in fixes], dtype=bool)
    is_own = seen & (errors <= _OFF_M)
    settled = seen & (times >= _SETTLED_S)
    nees = np.array([_nees(o, f.covariance) for o, f in zip(off, fixes, strict=True)])
    back = [_back_s(times[is_own], (b - begin_ns) * 1e-9) for _, b in chase.hidden_ns()
            if b < end_ns]  # fmt: skip
    last_s = float(times[is_own].max()) if is_own.any() else 0.0
    until_s = (end_ns - begin_ns) * 1e-9
    why = []
    if until_s - last_s > _LAST_S:
        why.append(f"last seen {last_s:.1f} s after the click, of {until_s:.0f}")
    why += [f"found {b:.1f} s after a roof" for b in back if b > _BACK_S]
    foreign = int((seen & (errors > _OFF_M)).sum())
    if foreign:
        why.append(f"{foreign} reports are of something else")
    speeds = _velocities(fixes, chase, settled)
    return FollowVerdict(
        not why, len(fixes), int(seen.sum()), tuple(back), foreign, *_spread(errors[settled]),
        _share(nees[settled]), float(np.quantile(speeds, 0.95)) if len(speeds) else float("nan"),
        tuple(why),
        tuple(float(e) for e in errors), tuple(float(t) for t in times),
    )  # fmt: skip


def _velocities(fixes: Sequence[FollowedFix], chase: Chase, chosen: NDArray[np.bool_]) -> Array:
    """Errors of the horizontal velocity (m/s) of the chosen positions that have one."""
    off = [
        np.linalg.norm((fix.velocity - chase.car.velocity_at(fix.time_ns))[:2])
        for fix, is_chosen in zip(fixes, chosen, strict=True)
        if is_chosen and fix.velocity is not None
    ]
    return np.array(off)


def _nees(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance[:2, :2], error))


def _back_s(times: Array, end_s: float) -> float:
    """Seconds from a roof's end to the first correct detection after it; infinite if there is none.
    times: of correct detections.
    """
    after = times[times >= end_s]
    return float(after.min() - end_s) if len(after) else float("inf")


def _spread(errors: Array) -> tuple[float, float, float]:
    if not len(errors):
        return (float("nan"),) * 3
    p50, p95 = np.quantile(errors, [0.5, 0.95])
    return float(p50), float(p95), float(errors.max())


def _share(nees: Array) -> float:
    return 100.0 * float(np.mean(nees <= _CHI2_95)) if len(nees) else float("nan")
