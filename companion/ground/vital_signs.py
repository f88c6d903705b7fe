"""The camera's view, and the quality of vision in a few numbers, for any ground station."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np

from companion.conversions import camera_view
from companion.ending import wait_for_end
from localizer.geometry.geo import LocalFrame
from localizer.targets.locate import RayCaster
from localizer.tracking.mailbox import Mailbox
from localizer.types import PoseEstimate, TrackingState
from mavlink_bridge.messages import CameraView

_log = logging.getLogger(__name__)
_PERIOD_S = 1.0
_WINDOW_NS = 5_000_000_000  # that the rate is taken over
_STALE_NS = 2_000_000_000  # without an accepted position: there is no signal
_KEPT = 512  # estimates: five seconds of a fast camera
_NONE, _WEAK, _FULL = 0.0, 1.0, 2.0


class VitalSigns:
    """Sends five named values every second, on its own thread.

    VPS_SIGNAL: 0 no position, 1 not reliable (initializing, degraded, bridging), 2 tracking;
    VPS_RATE: accepted positions per second; VPS_AGE: seconds since the newest one's exposure;
    VPS_SIGMA: its horizontal sigma, m; VPS_QUAL: its registration quality, 0 to 1. tell: receives
    them; must not block.
    """

    def __init__(self, tell: Callable[[Mapping[str, float]], None]) -> None:
        self._tell = tell
        self._accepted: deque[PoseEstimate] = deque(maxlen=_KEPT)
        self._state: TrackingState | None = None
        self._stop = threading.Event()
        self._failures = 0
        self._thread = threading.Thread(target=self._run, name="vital signs", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        wait_for_end(self._thread)

    def add_estimate(self, estimate: PoseEstimate) -> None:
        """Add an estimate, accepted or not. Never blocks."""
        self._state = estimate.state
        if estimate.accepted:
            self._accepted.append(estimate)

    def figures(self, now_ns: int) -> dict[str, float]:
        """The five named values (see the class) at a CLOCK_MONOTONIC time. Before the first
        accepted position only VPS_SIGNAL and VPS_RATE.
        """
        accepted = list(self._accepted)
        recent = sum(1 for e in accepted if 0 <= now_ns - e.exposure_time_ns < _WINDOW_NS)
        figures = {"VPS_SIGNAL": _NONE, "VPS_RATE": recent / (_WINDOW_NS * 1e-9)}
        if not accepted:
            return figures
        newest = accepted[-1]
        age_ns = now_ns - newest.exposure_time_ns
        figures["VPS_AGE"] = age_ns * 1e-9
        figures["VPS_SIGMA"] = float(np.sqrt(newest.covariance[0, 0] + newest.covariance[1, 1]))
        figures["VPS_QUAL"] = float(newest.quality)
        if age_ns <= _STALE_NS and self._state is not TrackingState.LOST:
            figures["VPS_SIGNAL"] = _FULL if self._state is TrackingState.TRACKING else _WEAK
        return figures

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            try:
                self._tell(self.figures(time.monotonic_ns()))
            except Exception:  # telemetry must not end the flight
                self._failures += 1
                if self._failures == 1:
                    _log.exception("the vital signs could not be sent")


class ViewReporter:
    """Computes the view and its ground point on its own thread, at most `rate_hz` times a second.

    cast: intersects rays with the map. look: receives the view; must not block.
    """

    def __init__(
        self,
        rate_hz: float,
        frame: LocalFrame,
        cast: RayCaster,
        look: Callable[[CameraView], None],
    ) -> None:
        self._period_s = 1.0 / rate_hz
        self._frame = frame
        self._cast = cast
        self._look = look
        self._newest: Mailbox[PoseEstimate] = Mailbox()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        self._newest.close()
        wait_for_end(self._thread)

    def add_estimate(self, estimate: PoseEstimate) -> None:
        """Set the estimate to report next; ignored unless accepted. Never blocks."""
        if estimate.accepted:
            self._newest.put(estimate)

    def _run(self) -> None:
        while (estimate := self._newest.take()) is not None:
            try:
                self._look(camera_view(estimate, self._frame, self._cast))
            except Exception:  # telemetry must not end the flight
                _log.exception("the camera's view could not be reported")
            self._stop.wait(self._period_s)
