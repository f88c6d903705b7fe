"""The ground station's clicks: which frame they point into, and when they are refused.

Each click is a target of its own: what was clicked before says nothing about it.
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Callable

import numpy as np

from companion.targets.detections import CLICKED, Detection
from companion.targets.reporter import TargetReporter
from localizer.types import PoseEstimate, ReferenceBundle, TrackingState
from mavlink_bridge.messages import TrackRequest

_OLDEST_NS = 2_000_000_000  # how old the pose may be that an operator's click is placed by
_WARNING = 4  # MAV_SEVERITY_WARNING
_REMEMBERED = 64  # clicked targets that a stop ends; each is shown for some seconds
_UNKNOWN = "PiLoT: no target: the camera's position is not known"
_UNCONFIRMED = "PiLoT: no target: the camera's position is not confirmed yet"


class ClickPolicy:
    """A click is the place under that pixel of the newest localized frame.

    say: tells the operator (MAV_SEVERITY, text).
    """

    def __init__(self, targets: TargetReporter, say: Callable[[int, str], None]) -> None:
        self._targets = targets
        self._say = say
        self._newest: PoseEstimate | None = None
        self._refused_ns: int | None = None
        self._numbers = itertools.count(1)
        self._clicked: deque[str] = deque(maxlen=_REMEMBERED)
        self._lock = threading.Lock()  # two links may both have a ground station

    def add_estimate(self, estimate: PoseEstimate, _: ReferenceBundle | None = None) -> None:
        """Note an estimate. Never blocks."""
        if estimate.accepted:
            self._newest = estimate

    def on_request(self, request: TrackRequest) -> None:
        """Take the operator's wish. Never blocks."""
        with self._lock:
            if request.kind == "stop":
                self._targets.forget(tuple(self._clicked))
                self._clicked.clear()
            else:
                self._begin(request)

    def _begin(self, request: TrackRequest) -> None:
        newest = self._newest
        if newest is None or request.time_ns - newest.exposure_time_ns > _OLDEST_NS:
            # The operator points into the present picture; an old pose would place it elsewhere.
            self._refuse(_UNKNOWN, request.time_ns)
            return
        if newest.state is not TrackingState.TRACKING:
            # One picture has found a place, and the next ones may still find another.
            self._refuse(_UNCONFIRMED, request.time_ns)
            return
        x, y = np.array(request.coordinates).reshape(-1, 2).mean(axis=0)
        u, v = x * newest.camera.width, y * newest.camera.height
        name = f"{CLICKED}{next(self._numbers)}"
        self._clicked.append(name)
        self._targets.add_detection(Detection(name, newest.exposure_time_ns, float(u), float(v)))

    def _refuse(self, why: str, time_ns: int) -> None:
        """Say it once to an impatient operator."""
        if self._refused_ns is None or time_ns - self._refused_ns > _OLDEST_NS:
            self._refused_ns = time_ns
            self._say(_WARNING, why)
