"""How long a reference view serves: as long as the camera sees nearly what it shows."""

from __future__ import annotations

import numpy as np

from localizer.geometry.pose import Pose
from localizer.types import ReferenceBundle

_PROBES = 64  # anchors whose places in the picture are compared
_LEAST_PROBES = 16
_LONGEST_NS = 1_000_000_000  # finer tiles may have come, also for a camera that hovers


def still_serves(bundle: ReferenceBundle, pose: Pose, time_ns: int, most_px: float) -> bool:
    """Whether a camera at `pose` sees the reference's anchors within `most_px` of where they are in
    the reference, 95 of 100 of them.

    Anchors are points of the map, so the registration does not care where they were seen from, as
    long as they look alike and the picture's border does not run dry.
    """
    if most_px <= 0 or not 0 <= time_ns - bundle.time_ns <= _LONGEST_NS:
        return False
    points, pixels = bundle.anchors.points_world, bundle.anchors.pixels
    if len(points) < _LEAST_PROBES:
        return False
    step = max(1, len(points) // _PROBES)
    seen, _ = bundle.view.camera.project(pose.inverse.apply(points[::step]))
    away = np.linalg.norm(seen - pixels[::step], axis=1)  # NaN behind the camera
    return bool(np.quantile(np.nan_to_num(away, nan=np.inf), 0.95, method="lower") <= most_px)
