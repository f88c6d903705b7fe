"""Ground heights for the odometry where the map has no geometry."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose

_STEPS = 8  # of the fixed-point iteration; terrain flatter than the rays are steep converges
_LEAST_DOWN = 0.05  # sine of the angle below the horizon of the flattest ray that is used
_LOW_SHARE = 0.3  # of the points, what counts as ground: below roofs and crowns
_SOUNDED_NS = 5_000_000_000  # of a rangefinder's readings: longer than a house lasts at 5 m/s
_LEAST_READINGS = 5
_LEAST_ABOVE_M = 1.0


class TerrainModel(Protocol):
    """Heights of the ground: a grid, a plane, or rangefinder readings."""

    def height(self, east: Array, north: Array) -> Array:
        """World z in metres at world positions (metres east and north, arrays of one shape)."""
        ...


@dataclass(frozen=True)
class FlatGround:
    """A horizontal plane. height_m: its world z."""

    height_m: float

    @classmethod
    def under(cls, points_world: Array) -> FlatGround:
        """The ground under surface points (N, 3), e.g. the last anchors that the map gave: 30 % of
        them are lower, roofs and crowns are higher.
        """
        return cls(float(np.quantile(points_world[:, 2], _LOW_SHARE)))

    def height(self, east: Array, north: Array) -> Array:
        """See `TerrainModel.height`."""
        del north
        return np.full(np.shape(east), self.height_m)


@dataclass(frozen=True)
class RaisedGround:
    """A terrain model raised by a constant, because its shape is used, not its datum."""

    ground: TerrainModel
    by_m: float

    @classmethod
    def onto(cls, ground: TerrainModel, points_world: Array) -> RaisedGround:
        """Raise `ground` so that it fits surface points (N, 3), e.g. the map's last ones."""
        above = points_world[:, 2] - ground.height(points_world[:, 0], points_world[:, 1])
        return cls(ground, float(np.quantile(above, _LOW_SHARE)))

    def height(self, east: Array, north: Array) -> Array:
        """See `TerrainModel.height`."""
        return self.ground.height(east, north) + self.by_m


class RangefinderGround:
    """Ground height by a rangefinder: a plane at the height of the lowest recent surface.

    The beam also hits roofs and crowns, and with a roof's height the depth of the image would be
    too short. So only the lowest of the recent readings are used.
    """

    def __init__(self) -> None:
        self._met: deque[tuple[int, float]] = deque()

    def add(self, time_ns: int, height_m: float) -> None:
        """Add the world z of the surface below at a time, in the order of time; readings of over 5
        s before it are dropped.
        """
        self._met.append((time_ns, height_m))
        while self._met[0][0] < time_ns - _SOUNDED_NS:
            self._met.popleft()

    def at(self, time_ns: int) -> FlatGround | None:
        """The plane from the readings of the 5 s up to a time; None with fewer than 5."""
        heights = [height for t, height in self._met if 0 <= time_ns - t <= _SOUNDED_NS]
        if len(heights) < _LEAST_READINGS:
            return None
        return FlatGround(float(np.quantile(heights, _LOW_SHARE)))


def height_above_ground(
    points_world: Array, covariance: Array, place: Array
) -> tuple[float, float]:
    """Mean and sigma (m) of a camera's height above ground points (N, 3), world axes; the mean is
    at least 1 m.

    place: (3,) the camera's position, covariance: its (3, 3). Around it the ground is assumed to
    continue with the slope of the visible ground.
    """
    centred = points_world - points_world.mean(axis=0)
    slope = np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)[0]
    J = np.array([-slope[0], -slope[1], 1.0])
    above_m = max(float(place[2] - points_world[:, 2].mean()), _LEAST_ABOVE_M)
    return above_m, float(np.sqrt(max(J @ covariance @ J, 0.0)))


def ground_points(
    ground: TerrainModel, world_from_camera: Pose, camera: Camera, pixels: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Intersections of pixels' rays (N, 2) with the ground: points (N, 3), and a mask (N,) of the
    rays that meet it; the other points are meaningless.
    """
    rays = camera.rays(pixels) @ world_from_camera.rotation.T
    steep = -rays[:, 2] > _LEAST_DOWN * np.linalg.norm(rays, axis=1)
    down = np.where(steep, rays[:, 2], -1.0)
    origin = world_from_camera.translation
    level = np.full(len(rays), float(ground.height(origin[:1], origin[1:2])[0]))
    for _ in range(_STEPS):
        points = origin + rays * ((level - origin[2]) / down)[:, None]
        level = np.asarray(ground.height(points[:, 0], points[:, 1]), dtype=np.float64)
    points = origin + rays * ((level - origin[2]) / down)[:, None]
    return points, steep & (origin[2] - level > 0)
