"""Reports the camera's view a few times a second, as `CameraView` of the newest estimate."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from companion.conversions import camera_view
from companion.ending import wait_for_end
from localizer.geometry.geo import LocalFrame
from localizer.targets.locate import RayCaster
from localizer.tracking.mailbox import Mailbox
from localizer.types import PoseEstimate
from mavlink_bridge.messages import CameraView

_log = logging.getLogger(__name__)


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
