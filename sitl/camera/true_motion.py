"""True motion of the vehicle and its camera: samples and their interpolation."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from companion.geometry import (
    GimbalAngles,
    Mount,
    camera_attitude,
    world_from_camera,
)
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose, matrix_from_quaternion, so3_exp, so3_log


@dataclass(frozen=True)
class TruthSample:
    """True state of the vehicle at a time (CLOCK_MONOTONIC).

    position: (3,) m, map ENU; body: quaternion (w, x, y, z), FRD to NED; gimbal: the camera's true
    angles.
    """

    time_ns: int
    position: Array
    body: Array
    gimbal: GimbalAngles


def camera_pose(sample: TruthSample, frame: LocalFrame, mount: Mount) -> Pose:
    """The camera's true pose world_from_camera from the vehicle's. frame: the map's ENU."""
    to_ned = frame.ned_from_enu(frame.position(sample.position))
    body = matrix_from_quaternion(sample.body)
    attitude = camera_attitude(body, sample.gimbal, mount)
    return world_from_camera(sample.position, body, attitude, mount.lever_arm_m, to_ned)


class PoseTrack:
    """Camera poses in time order with interpolation. Only the newest `keep` samples are kept."""

    def __init__(self, samples: Iterable[tuple[int, Pose]] = (), keep: int | None = 2000) -> None:
        self._samples: deque[tuple[int, Pose]] = deque(maxlen=keep)
        for time_ns, pose in samples:
            self.add(time_ns, pose)

    def add(self, time_ns: int, pose: Pose) -> None:
        """Append a sample; one that is not newer than the newest is ignored."""
        if not self._samples or time_ns > self._samples[-1][0]:
            self._samples.append((time_ns, pose))

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest sample; None without samples."""
        return self._samples[-1][0] if self._samples else None

    def at(self, time_ns: int) -> Pose | None:
        """world_from_camera at a time, interpolated; None outside the samples."""
        if not self._samples or not self._samples[0][0] <= time_ns <= self._samples[-1][0]:
            return None
        later = self._samples[-1]
        for earlier in reversed(self._samples):  # what is asked for is nearly always recent
            if earlier[0] <= time_ns:
                return _between(earlier, later, time_ns)
            later = earlier
        return None


def _between(a: tuple[int, Pose], b: tuple[int, Pose], time_ns: int) -> Pose:
    if a[0] == b[0]:
        return a[1]
    t = (time_ns - a[0]) / (b[0] - a[0])
    turn = so3_log(a[1].rotation.T @ b[1].rotation)
    return Pose(
        a[1].rotation @ so3_exp(t * turn),
        np.asarray(a[1].translation + t * (b[1].translation - a[1].translation)),
    )
