"""The ground station's clicks: which frame they point into, and when they are refused."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from companion.flight.detections import Detection
from localizer.types import PoseEstimate, ReferenceBundle
from mavlink_bridge.messages import TrackRequest

_OLDEST_NS = 2_000_000_000  # how old the pose may be that an operator's click is placed by
_WARNING = 4  # MAV_SEVERITY_WARNING


class ClickPolicy:
    """A click is the place under that pixel of the newest localized frame.

    say: tells the operator (MAV_SEVERITY, text).
    """

    def __init__(
        self, add_detection: Callable[[Detection], None], say: Callable[[int, str], None]
    ) -> None:
        self._add_detection = add_detection
        self._say = say
        self._newest: PoseEstimate | None = None
        self._refused_ns = 0

    def add_estimate(self, estimate: PoseEstimate, _: ReferenceBundle | None = None) -> None:
        """Note an estimate. Never blocks."""
        if estimate.accepted:
            self._newest = estimate

    def on_request(self, request: TrackRequest) -> None:
        """Take the operator's wish. Never blocks."""
        newest = self._newest
        if request.kind == "stop":
            return
        if newest is None or request.time_ns - newest.exposure_time_ns > _OLDEST_NS:
            # The operator points into the present picture; an old pose would place it elsewhere.
            if request.time_ns - self._refused_ns > _OLDEST_NS:
                self._refused_ns = request.time_ns
                self._say(_WARNING, "PiLoT: no target: the camera's position is not known")
            return
        x, y = np.array(request.coordinates).reshape(-1, 2).mean(axis=0)
        u, v = x * newest.camera.width, y * newest.camera.height
        detection = Detection("ground station", newest.exposure_time_ns, float(u), float(v))
        self._add_detection(detection)
