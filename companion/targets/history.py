"""Camera poses of the last seconds, by exposure time."""

from __future__ import annotations

import threading
from bisect import bisect
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from localizer.geometry.pose import Array, Pose, so3_exp, so3_log
from localizer.types import PoseEstimate

_KEPT = 256
_GAP_NS = 1_000_000_000  # between poses that a third one is taken from
_NEAR_NS = 20_000_000  # a frame's own pose: no other is nearer
# What a camera's motion changes by where nothing shows it: m/s², and rad/s² of a gimbal that holds.
_LEAST_CHANGE = np.repeat([0.5, 0.05], 3)


class PoseHistory:
    """The newest 256 accepted estimates in order of exposure. Thread-safe."""

    def __init__(self) -> None:
        self._estimates: deque[PoseEstimate] = deque(maxlen=_KEPT)
        self._lock = threading.Lock()

    def add(self, estimate: PoseEstimate) -> None:
        """Add an accepted estimate; one that is not newer than the last is ignored."""
        with self._lock:
            last = self._estimates[-1] if self._estimates else None
            if last is None or estimate.exposure_time_ns > last.exposure_time_ns:
                self._estimates.append(estimate)

    @property
    def newest(self) -> PoseEstimate | None:
        """The newest estimate; None before the first."""
        with self._lock:
            return self._estimates[-1] if self._estimates else None

    def at(self, time_ns: int) -> PoseEstimate | None:
        """The estimate at time_ns (exposure, CLOCK_MONOTONIC); between frames it is interpolated,
        with the worse covariance and state of both neighbours, increased by the possible change of
        motion.

        None outside the history, and in gaps above a second.
        """
        with self._lock:
            kept = list(self._estimates)
        times = [e.exposure_time_ns for e in kept]
        k = bisect(times, time_ns)
        beside = kept[max(0, k - 1) : k + 1]
        near = min(beside, key=lambda e: abs(e.exposure_time_ns - time_ns), default=None)
        if near is not None and abs(near.exposure_time_ns - time_ns) <= _NEAR_NS:
            return near
        if k in (0, len(kept)) or times[k] - times[k - 1] > _GAP_NS:
            return None
        between = _between(kept[k - 1], kept[k], time_ns)
        change = _change(kept[max(0, k - 2) : k + 2])
        sigma = _swing_s2(kept[k - 1], kept[k], time_ns) * np.maximum(change, _LEAST_CHANGE)
        return replace(between, covariance=between.covariance + np.diag(sigma**2))


def _swing_s2(a: PoseEstimate, b: PoseEstimate, time_ns: int) -> float:
    """Error of linear interpolation between two poses per unit of acceleration: ``s (1 - s) T² /
    2``, squared seconds.
    """
    gap_s = (b.exposure_time_ns - a.exposure_time_ns) * 1e-9
    share = (time_ns - a.exposure_time_ns) * 1e-9 / gap_s
    return 0.5 * share * (1.0 - share) * gap_s**2


def _change(about: Sequence[PoseEstimate]) -> Array:
    """(6,) m/s² and rad/s², world axes: the largest change of motion from one of up to four
    neighbours to the next; 0 for two.
    """
    motions = [_motion(a, b) for a, b in pairwise(about)]
    most = np.zeros(6)
    for (v, at_s), (w, later_s) in pairwise(motions):
        most = np.maximum(most, np.abs(w - v) / (later_s - at_s))
    return most


def _motion(a: PoseEstimate, b: PoseEstimate) -> tuple[Array, float]:
    """Mean velocity and turn rate (6,), m/s, rad/s, between two poses; the middle's time, s."""
    p, q = a.world_from_camera, b.world_from_camera
    moved = np.concatenate([q.translation - p.translation, so3_log(q.rotation @ p.rotation.T)])
    span_s = (b.exposure_time_ns - a.exposure_time_ns) * 1e-9
    return moved / span_s, 0.5 * (a.exposure_time_ns + b.exposure_time_ns) * 1e-9


def _between(a: PoseEstimate, b: PoseEstimate, time_ns: int) -> PoseEstimate:
    share = (time_ns - a.exposure_time_ns) / (b.exposure_time_ns - a.exposure_time_ns)
    p, q = a.world_from_camera, b.world_from_camera
    turn = so3_log(q.rotation @ p.rotation.T)
    pose = Pose(
        so3_exp(share * turn) @ p.rotation,
        (1.0 - share) * p.translation + share * q.translation,
    )
    worse = max(a, b, key=lambda e: float(e.covariance.trace()))
    state = a.state if a.state is not b.state and b.state.value == "tracking" else b.state
    return replace(
        b, world_from_camera=pose, covariance=worse.covariance, state=state,
        exposure_time_ns=time_ns,
    )  # fmt: skip
