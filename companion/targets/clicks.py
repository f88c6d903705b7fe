"""Assigns a ground station's clicks to frames, and refuses invalid ones.

Each click is a new target. The operator sees an older frame than the camera's newest: the clicked
frame is the one exposed `targets.operator_delay_ms` before the click arrived. The camera
poses of the last seconds are kept by exposure time.
"""

from __future__ import annotations

import threading
from bisect import bisect
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from companion.config import TargetConfig
from companion.targets.reporter import TargetReporter
from companion.targets.target_manager import Click
from localizer.geometry.pose import Array, Pose, so3_exp, so3_log
from localizer.types import PoseEstimate, ReferenceBundle, TrackingState
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import ClickRefusal
from mavlink_bridge.messages import TrackRequest

_OLDEST_NS = 2_000_000_000  # how long the pose of a click's frame is waited for
_FRAME_NS = 60_000_000  # a frame so near to the wanted time is the one that was seen
_MOST = 8  # clicked targets at a time


class ClickPolicy:
    """Finds each click's frame among the past poses, and begins or ends its target.

    targets: receives the clicks; report: sends an alert to the operator.
    """

    def __init__(
        self, targets: TargetReporter, report: Callable[[Alert], None], config: TargetConfig
    ) -> None:
        self._targets = targets
        self._report = report
        self._delay_ns = round(config.operator_delay_ms * 1e6)
        self._sigma_ns = round(config.operator_delay_sigma_ms * 1e6)
        self._history = PoseHistory()
        self._waiting: list[TrackRequest] = []
        self._alive: list[Click] = []
        self._refused: tuple[int, str] | None = None
        self._lock = threading.Lock()  # two links may both have a ground station

    def add_estimate(self, estimate: PoseEstimate, _: ReferenceBundle | None = None) -> None:
        """Add an estimate (its pose if accepted) and process clicks that waited. Never blocks."""
        if estimate.accepted:
            self._history.add(estimate)
        if not self._waiting:
            return
        with self._lock:
            self._waiting = [
                r for r in self._waiting if not self._try_begin(r, estimate.exposure_time_ns)
            ]

    def on_request(self, request: TrackRequest) -> None:
        """Begin the target of a click, or refuse it with an alert; it waits up to 2 s for the pose
        of its frame. Kind "stop": end the clicked target of its number, or all for number 0. Never
        blocks.
        """
        with self._lock:
            if request.kind == "stop":
                self._stop(request.number)
            elif not self._try_begin(request, request.time_ns):
                self._waiting.append(request)

    def on_gone(self, name: str) -> None:
        """A target of that name has ended: it no longer counts among the 8 clicked ones."""
        with self._lock:
            self._alive = [c for c in self._alive if c.name != name]

    def _stop(self, number: int) -> None:
        """End the clicked target with this number; 0 ends all of them."""
        self._waiting = [r for r in self._waiting if number not in (0, r.number)]
        ended = [c for c in self._alive if number in (0, c.number)]
        self._alive = [c for c in self._alive if number not in (0, c.number)]
        self._targets.forget(tuple(c.name for c in ended))

    def _try_begin(self, request: TrackRequest, now_ns: int) -> bool:
        """Begin or refuse the request's target; False while its frame's pose may still arrive."""
        wanted_ns = request.time_ns - self._delay_ns
        newest = self._history.newest
        if newest is None or now_ns - newest.exposure_time_ns > _OLDEST_NS:
            # The operator points into the present picture; an old pose would place it elsewhere.
            self._refuse(request, ClickRefusal.UNKNOWN)
            return True
        estimate = self._history.at(wanted_ns)
        if estimate is None and abs(newest.exposure_time_ns - wanted_ns) <= _FRAME_NS:
            estimate = newest
        is_early = estimate is None and newest.exposure_time_ns < wanted_ns
        if is_early and now_ns - request.time_ns <= _OLDEST_NS:
            return False
        if estimate is None:
            self._refuse(request, ClickRefusal.UNKNOWN)
        elif estimate.state is not TrackingState.TRACKING:
            # One picture has found a place, and the next ones may still find another.
            self._refuse(request, ClickRefusal.UNCONFIRMED)
        else:
            self._begin(request, estimate)
        return True

    def _begin(self, request: TrackRequest, estimate: PoseEstimate) -> None:
        camera = estimate.camera
        x, y = request.coordinates[0::2], request.coordinates[1::2]
        extent = None
        if request.kind == "rectangle":
            extent = ((x[1] - x[0]) * camera.width, (y[1] - y[0]) * camera.height)
        pixel = (sum(x) / len(x) * camera.width, sum(y) / len(y) * camera.height)
        frame_ns = estimate.exposure_time_ns
        around = tuple(
            at
            for at in (self._history.at(frame_ns + s * self._sigma_ns) for s in (-1, 1))
            if at is not None
        )
        click = Click(request.number, estimate, pixel, around, extent, request.asked_by)
        self._alive.append(click)
        if len(self._alive) > _MOST:
            oldest = self._alive.pop(0)
            self._targets.forget((oldest.name,))
            self._report(alert(AlertId.TARGET_REPLACED, number=oldest.number))
        self._targets.begin(click)

    def _refuse(self, request: TrackRequest, why: ClickRefusal) -> None:
        """Report the reason, at most every 2 s for the same reason."""
        if self._refused is None or (
            request.time_ns - self._refused[0] > _OLDEST_NS or self._refused[1] != why
        ):
            self._refused = (request.time_ns, why)
            self._report(alert(AlertId.NO_TARGET, why=why))


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
