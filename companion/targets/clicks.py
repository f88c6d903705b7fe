"""Assigns a ground station's clicks to frames, and refuses invalid ones.

Each click is a new target. The operator sees an older frame than the camera's newest: the clicked
frame is the one exposed `targets.operator_delay_ms` before the click arrived.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from companion.config import TargetConfig
from companion.targets.history import PoseHistory
from companion.targets.reporter import TargetReporter
from companion.targets.target_manager import Click
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
