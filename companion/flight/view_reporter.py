"""Where the camera looks, a few times a second: the newest estimate becomes a `CameraView`."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable

from companion.geometry import GIMBAL_FROM_CAMERA, ned_from_world
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import quaternion_from_matrix
from localizer.targets.locate import RayCaster, ray_in_world
from localizer.types import PoseEstimate
from mavlink_bridge.messages import CameraView

_log = logging.getLogger(__name__)


def camera_view(estimate: PoseEstimate, frame: LocalFrame, cast: RayCaster) -> CameraView:
    """Camera and the ground in the picture's centre; NaN where that ray meets no map."""
    pose, camera = estimate.world_from_camera, estimate.camera
    position = frame.position(pose.translation)
    ned_from_camera = ned_from_world(frame, position) @ pose.rotation
    w, x, y, z = quaternion_from_matrix(ned_from_camera @ GIMBAL_FROM_CAMERA.T)
    eye, direction = ray_in_world(estimate, (camera.width / 2.0, camera.height / 2.0))
    distance = float(cast(eye, direction[None, :]).distances[0])
    ground = (math.nan, math.nan, math.nan)
    if math.isfinite(distance):
        seen = frame.position(eye + distance * direction)
        ground = (seen.latitude_deg, seen.longitude_deg, seen.height_m)
    return CameraView(
        estimate.exposure_time_ns,
        position.latitude_deg,
        position.longitude_deg,
        position.height_m,
        (float(w), float(x), float(y), float(z)),
        *ground,
    )


class ViewReporter:
    """Casts the ray on a thread of its own, at most `rate_hz` times a second.

    look: takes the view; must not block.
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
        self._newest: PoseEstimate | None = None
        self._came = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="view")

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        self._came.set()
        self._thread.join()

    def add_estimate(self, estimate: PoseEstimate) -> None:
        """Offer an estimate; only accepted ones are told. Never blocks."""
        if estimate.accepted:
            self._newest = estimate
            self._came.set()

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            self._came.wait()
            self._came.clear()
            estimate = self._newest
            if estimate is None or self._stop.is_set():
                continue
            try:
                self._look(camera_view(estimate, self._frame, self._cast))
            except Exception:  # telemetry must not end the flight
                _log.exception("the camera's view could not be told")
