"""Pixels to places: ray casting from the estimated pose, with covariance, and a target filter.

Paper, Sec. 3.3.2 (end): a query pixel is mapped to the map by a ray from the estimated pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import predict as kalman_predict
from filterpy.kalman import update as kalman_update

from localizer.map.pick import cast_rays
from localizer.map.tile import TileMesh
from localizer.pose import Array, hat
from localizer.types import PoseEstimate, TargetFix

_NORMAL_ANGLE = 4e-3  # rad: half a metre at 120 m


@dataclass(frozen=True)
class SurfacePoint:
    """Where a ray meets the map. position: (3,) world metres; normal: (3,) unit."""

    position: Array
    normal: Array


def ray_in_world(estimate: PoseEstimate, pixel: tuple[float, float]) -> tuple[Array, Array]:
    """Origin (3,) and unit direction (3,) in world axes of a pixel of the (distorted) frame."""
    direction = estimate.world_from_camera.rotation @ estimate.camera.rays(np.asarray(pixel))
    return estimate.world_from_camera.translation, direction / np.linalg.norm(direction)


def cast_ray(meshes: Sequence[TileMesh], origin: Array, direction: Array) -> SurfacePoint | None:
    """Where a ray (origin (3,), unit direction (3,), world) first meets the map; None if nowhere.

    The normal is that of the plane through three neighbouring hits, so that a single triangle of a
    rough mesh does not decide it.
    """
    sideways = np.linalg.svd(direction[None, :])[2][1:]
    offsets = _NORMAL_ANGLE * np.array([[0.0, 0.0], [1.0, 0.0], [-0.5, 0.9], [-0.5, -0.9]])
    directions = direction + offsets @ sideways
    t = cast_rays(meshes, origin, directions)
    if not np.isfinite(t[0]):
        return None
    points = origin + directions * t[:, None]
    normal = np.cross(points[2] - points[1], points[3] - points[1])
    length = float(np.linalg.norm(normal))
    if not np.isfinite(length) or length == 0.0:
        normal, length = -direction, 1.0  # at the map's border: as if it faced the camera
    return SurfacePoint(points[0], normal / length)


def target_covariance(
    estimate: PoseEstimate, hit: SurfacePoint, pixel_sigma: float, map_sigma_m: float
) -> Array:
    """Covariance (3, 3) in m², world axes, of a ray's meeting point with the surface.

    First order about the tangent plane with normal n: for a ray ``C + s d`` the point moves by
    ``M dC`` and by ``M s [phi]x d`` with ``M = I - d n' / (n' d)``. A pixel's error is a rotation
    of the ray by ``pixel_sigma / f``; the map's own error adds along the normal.
    """
    centre = estimate.world_from_camera.translation
    offset = hit.position - centre
    distance = float(np.linalg.norm(offset))
    d, n = offset / distance, hit.normal
    # At grazing incidence the plane model explodes: 3 degrees is where we stop believing it.
    cosine = float(n @ d)
    cosine = np.copysign(max(abs(cosine), 0.05), cosine or -1.0)
    M = np.eye(3) - np.outer(d, n) / cosine
    J = np.hstack([M, -M @ hat(offset)])
    pixel_angle = pixel_sigma / estimate.camera.fx
    across = np.eye(3) - np.outer(d, d)
    P = J @ estimate.covariance @ J.T
    P += M @ across @ M.T * (distance * pixel_angle) ** 2
    P += np.outer(d, d) * (map_sigma_m / cosine) ** 2
    return 0.5 * (P + P.T)


class TargetFilter:
    """Constant-velocity Kalman filter of one target's position (filterpy)."""

    def __init__(self, acceleration_sigma: float = 1.5, gate: float = 25.0) -> None:
        self._acceleration_sigma = acceleration_sigma
        self._gate = gate
        self._mean: Array | None = None
        self._covariance: Array = np.eye(6)
        self._time_ns = 0
        self._rejected = 0

    @property
    def velocity(self) -> Array:
        """Velocity (3,) in m/s, world axes; zero before the second fix."""
        return np.zeros(3) if self._mean is None else self._mean[3:].copy()

    def update(self, fix: TargetFix) -> TargetFix:
        """Fuse a fix; returns it smoothed. Three outliers in a row restart the filter."""
        if self._mean is None or self._rejected >= 3:
            self._restart(fix)
            return fix
        mean, P = self._predict(fix.exposure_time_ns)
        H = np.hstack([np.eye(3), np.zeros((3, 3))])
        innovation = fix.position_world - mean[:3]
        distance = innovation @ np.linalg.solve(P[:3, :3] + fix.covariance, innovation)
        if distance > self._gate:
            self._rejected += 1
        else:
            self._rejected = 0
            mean, P = kalman_update(mean, P, fix.position_world, fix.covariance, H)
        self._mean, self._covariance = np.asarray(mean), np.asarray(P)
        self._time_ns = fix.exposure_time_ns
        return TargetFix(
            fix.target_id,
            self._mean[:3].copy(),
            self._covariance[:3, :3].copy(),
            fix.pixel,
            fix.exposure_time_ns,
        )

    def _restart(self, fix: TargetFix) -> None:
        self._mean = np.concatenate([fix.position_world, np.zeros(3)])
        self._covariance = np.zeros((6, 6))
        self._covariance[:3, :3] = fix.covariance
        self._covariance[3:, 3:] = np.eye(3) * 10.0**2
        self._time_ns, self._rejected = fix.exposure_time_ns, 0

    def _predict(self, time_ns: int) -> tuple[Array, Array]:
        dt = max((time_ns - self._time_ns) * 1e-9, 1e-3)
        F = np.eye(6)
        F[:3, 3:] = np.eye(3) * dt
        q = Q_discrete_white_noise(2, dt, self._acceleration_sigma**2)
        Q = np.kron(q, np.eye(3))
        mean, P = kalman_predict(self._mean, self._covariance, F, Q)
        return np.asarray(mean), np.asarray(P)
