"""Rolling shutter: image rows are exposed one after the other while the camera moves.

At 60 degrees a second, a readout of 20 ms stretches the image by 2 to 3 per cent. Without
correction the error is three metres and one and a half degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose

_PASSES = 2  # a point's row decides where it is seen, and so its row
_LEAST_PX = 0.02  # a sweep that moves nothing by more is none


@dataclass(frozen=True)
class Sweep:
    """The camera's motion between the exposures of its first and last row, world axes.

    turn: (3,) rad, as a left rotation vector. way: (3,) metres. Both rates are constant during the
    readout.
    """

    turn: Array
    way: Array

    @classmethod
    def of(cls, rate: Array, velocity: Array, readout_ms: float) -> Sweep:
        """From angular rate (3,), rad/s, and velocity (3,), m/s, in world axes."""
        readout_s = 1e-3 * readout_ms
        return cls(np.asarray(rate) * readout_s, np.asarray(velocity) * readout_s)

    def displaces_pixels(self, camera: Camera, depth_m: float) -> bool:
        """Whether the motion displaces a point at depth_m (metres) by more than 0.02 px."""
        angle = float(np.linalg.norm(self.turn) + np.linalg.norm(self.way) / max(depth_m, 1.0))
        return 0.5 * angle * max(camera.fx, camera.fy) > _LEAST_PX

    def apparent_points(self, points: Array, world_from_camera: Pose, camera: Camera) -> Array:
        """World points (N, 3), moved so that a camera at rest sees each in the same pixel as the
        moving camera. The camera at rest is at `world_from_camera`, the pose in the middle of the
        readout.

        Exact to second order in the rotation: 6 mm at 120 m and 60 degrees a second.
        """
        away = points - world_from_camera.translation
        moved = away
        for _ in range(_PASSES):
            share = self._share(moved, world_from_camera, camera)
            moved = np.empty_like(away)
            _move(away, share, self.turn, self.way, moved)
        seen: Array = world_from_camera.translation + moved
        return seen

    @staticmethod
    def _share(away: Array, world_from_camera: Pose, camera: Camera) -> Array:
        """(N,) readout time of each point's row: -0.5 for the first to 0.5 for the last."""
        x, y, z = world_from_camera.rotation.T @ away.T
        z = np.where(z > 1e-6, z, np.nan)  # behind the camera: the middle row
        rows = (camera.fy * camera.distorted(x / z, y / z)[1] + camera.cy) / camera.height - 0.5
        return np.clip(np.nan_to_num(rows), -0.5, 0.5)


@njit(cache=True, nogil=True)
def _move(away, share, turn, way, moved):  # type: ignore[no-untyped-def]
    """Points after their share of way and turn, to second order in the turn; NumPy takes six times
    as long.
    """
    a, b, c = turn
    for k in range(len(away)):
        s = share[k]
        x, y, z = away[k, 0] - s * way[0], away[k, 1] - s * way[1], away[k, 2] - s * way[2]
        p, q, r = b * z - c * y, c * x - a * z, a * y - b * x
        half = 0.5 * s * s
        moved[k, 0] = x - s * p + half * (b * r - c * q)
        moved[k, 1] = y - s * q + half * (c * p - a * r)
        moved[k, 2] = z - s * r + half * (a * q - b * p)
