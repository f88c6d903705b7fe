"""The region in which the camera can be since the last registration.

If the EKF has lost its position, it gives no region. But the aircraft was located seconds ago,
moved as its IMU says, and no faster than it can. So a search need not begin with the whole map,
where other ground looks similar.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace

import numpy as np

from companion.inertial import InertialDisplacement, InertialTrack
from localizer.geometry.geo import NED_FROM_ENU
from localizer.geometry.pose import Array
from localizer.relocalization.types import SearchRegion
from localizer.sensors.error_model import SENSORS
from localizer.types import PoseEstimate, ReferenceBundle, TrackingState
from mavlink_bridge.bridge import Bridge

_SIGMAS = 3.0
_LEAST_M = 15.0  # candidates of the search are metres off themselves
_GUST_M_S = 8.0  # by which a wind carries an aircraft that holds nothing, beyond its own speed


@dataclass(frozen=True)
class _ConfirmedPosition:
    """A confirmed position (2,), east and north, m, with its velocity (2,), m/s.

    begun: the IMU's integral at that time, None until the IMU record reaches it; run: the
    integral's number of restarts.
    """

    time_ns: int
    place: Array
    velocity: Array
    begun: InertialDisplacement | None = None
    run: int = 0


class ReachableRegion:
    """Computes the reachable region from the last confirmed position and the IMU (`track`).

    `add_estimate` is called on the localization thread, `follow` on the video thread some times a
    second, `region` on the search thread.
    """

    def __init__(self, vehicle: Bridge, track: InertialTrack) -> None:
        self._vehicle, self._track = vehicle, track
        self._lock = threading.Lock()
        self._seen: _ConfirmedPosition | None = None

    def add_estimate(self, estimate: PoseEstimate, _: ReferenceBundle) -> None:
        """Store a position that the map confirmed, with the EKF's velocity (zero if unknown); other
        estimates are ignored.
        """
        if not estimate.accepted or estimate.state is not TrackingState.TRACKING:
            return
        velocity = self._vehicle.state().local_velocity_ned or (0.0, 0.0, 0.0)
        place = estimate.world_from_camera.translation[:2].copy()
        moving = (NED_FROM_ENU.T @ np.array(velocity))[:2]
        with self._lock:
            self._seen = _ConfirmedPosition(estimate.exposure_time_ns, place, moving)

    def follow(self) -> None:
        """Integrate the new IMU samples, about ten a call."""
        with self._lock:
            self._follow()

    def region(self, time_ns: int) -> SearchRegion | None:
        """Region of the camera at a CLOCK_MONOTONIC time, map axes; None before the newest
        confirmed position, or without one.
        """
        with self._lock:
            self._follow()
            seen, end, run = self._seen, self._track.at(self._track.newest_ns), self._track.restarts
        if seen is None or time_ns < seen.time_ns:
            return None
        t = (time_ns - seen.time_ns) * 1e-9
        speed = float(np.linalg.norm(seen.velocity))
        farthest_m = _LEAST_M + (speed + _GUST_M_S) * t
        way = _displacement(seen, end) if run == seen.run else None
        radius_m = _LEAST_M + _SIGMAS * SENSORS.inertial_drift.sigma_m(t)
        # An integral that lies beyond what can be flown is a wrong one.
        if way is None or radius_m > farthest_m or float(np.linalg.norm(way)) > farthest_m:
            return SearchRegion.circle(seen.place, farthest_m)
        return SearchRegion.circle(seen.place + way, radius_m)

    def _follow(self) -> None:
        self._track.follow(self._vehicle)
        seen = self._seen
        if seen is not None and seen.begun is None:
            begun = self._track.at(seen.time_ns)
            self._seen = replace(seen, begun=begun, run=self._track.restarts)


def _displacement(seen: _ConfirmedPosition, end: InertialDisplacement | None) -> Array | None:
    """Displacement (east, north), m, from the confirmed position to `end` by the IMU; None if the
    IMU record does not reach back.
    """
    if seen.begun is None or end is None:
        return None
    t = (end.time_ns - seen.begun.time_ns) * 1e-9
    moved = end.position - seen.begun.position - seen.begun.velocity * t
    way: Array = moved[::-1] + seen.velocity * t
    return way if np.isfinite(way).all() else None
