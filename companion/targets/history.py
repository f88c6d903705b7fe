"""The poses of the last seconds: where the camera was when a picture was taken."""

from __future__ import annotations

import threading
from bisect import bisect
from collections import deque
from dataclasses import replace

from localizer.geometry.pose import Pose, so3_exp, so3_log
from localizer.types import PoseEstimate

_KEPT = 256
_GAP_NS = 1_000_000_000  # between poses that a third one is taken from
_NEAR_NS = 20_000_000  # a frame's own pose: no other is nearer


class PoseHistory:
    """Accepted estimates in the order of their exposure. Safe to use from several threads."""

    def __init__(self) -> None:
        self._estimates: deque[PoseEstimate] = deque(maxlen=_KEPT)
        self._lock = threading.Lock()

    def add(self, estimate: PoseEstimate) -> None:
        """Keep an accepted estimate; one that is no newer than the last is left out."""
        with self._lock:
            last = self._estimates[-1] if self._estimates else None
            if last is None or estimate.exposure_time_ns > last.exposure_time_ns:
                self._estimates.append(estimate)

    @property
    def newest(self) -> PoseEstimate | None:
        """The last one; None before the first."""
        with self._lock:
            return self._estimates[-1] if self._estimates else None

    def at(self, time_ns: int) -> PoseEstimate | None:
        """The estimate at a time, between two neighbours where it has no frame of its own.

        Between two, the worse covariance and state of both are told. None outside of what is kept,
        and in a gap of more than a second.
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
        return _between(kept[k - 1], kept[k], time_ns)


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
