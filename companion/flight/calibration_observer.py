"""Passes some registrations a second to the calibration watch, with the distance to the ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from companion.calibration_watch.observation import CalibrationObservation
from companion.conversions import CameraExtrinsics
from localizer.types import Float32, PoseEstimate, ReferenceBundle, TrackingState
from mavlink_bridge.messages import VisionFix

_INTERVAL_NS = 250_000_000
_EVERY = 8  # pixel of the depth


class CalibrationObserver:
    """Passes an observation to `take` four times a second; runs on the localization thread."""

    def __init__(
        self, extrinsics: CameraExtrinsics, take: Callable[[CalibrationObservation], None]
    ) -> None:
        self._extrinsics, self._take = extrinsics, take
        self._next_ns = 0

    def add_fix(self, estimate: PoseEstimate, bundle: ReferenceBundle, fix: VisionFix) -> None:
        """Pass on a registration against the map, at most one in 0.25 s; ignored unless TRACKING
        and with the map in the middle of `bundle`'s view. Waits only for `take`. fix: of this
        estimate, before the checks, which may have held it.
        """
        time_ns = estimate.exposure_time_ns
        if estimate.state is not TrackingState.TRACKING or time_ns < self._next_ns:
            return
        self._next_ns = time_ns + _INTERVAL_NS
        depth_m = middle_depth_m(bundle.view.depth)
        if depth_m is not None:
            self._take(self._observation(estimate, fix, depth_m))

    def _observation(
        self, estimate: PoseEstimate, fix: VisionFix, depth_m: float
    ) -> CalibrationObservation:
        pose, frame = estimate.world_from_camera, self._extrinsics.frame
        return CalibrationObservation(
            fix.time_ns,
            (fix.latitude_deg, fix.longitude_deg, fix.height_m),
            fix.horizontal_sigma_m,
            frame.ned_from_enu(frame.position(pose.translation)) @ pose.rotation,
            depth_m,
            estimate.camera.horizontal_fov_deg,
        )


def middle_depth_m(depth: Float32) -> float | None:
    """Median over the middle half of a view's depth (H, W), metres, 0 where no map is; None if the
    map covers a quarter of it or less.
    """
    h, w = depth.shape
    middle = depth[h // 4 : 3 * h // 4 : _EVERY, w // 4 : 3 * w // 4 : _EVERY]
    seen = middle[middle > 0.0]
    return float(np.median(seen)) if seen.size > middle.size // 4 else None
