"""Moving cars and people of the simulated world. Their positions are pure functions of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.tile import TileMesh
from localizer.synth.tiles.vegetation import CAR_COLOURS, car_mesh, person_mesh
from localizer.synth.world import WorldInfo

# From the right-hand lane that a world gives: the lane of the other direction is 4.4 m to its left.
_OTHER_LANE_M = 4.4
_PAVEMENT_M = 4.0
_CAR_MPS = (7.0, 14.0)
_WALK_MPS = (1.0, 1.7)
_CLOTHES = ((70, 84, 120), (150, 60, 50), (200, 190, 170), (60, 90, 60), (40, 40, 44))


def traffic(
    world: WorldInfo,
    frame: LocalFrame,
    *,
    cars: int = 30,
    people: int = 40,
    seed: int = 0,
    epoch_ns: int = 0,
) -> tuple[Mover, ...]:
    """Place moving cars (names ``car0``...) and people (``person0``...) on the world's main roads
    and pavements; () without roads.

    frame: the map's ENU, of all positions. The same arguments give the same traffic.
    """
    if not world.roads:  # a map of the user's has none that are known
        return ()
    rng = np.random.default_rng([seed, 71])
    driving = [_path(world, frame, lane, 0.0, _OTHER_LANE_M) for lane in world.roads]
    walking = [
        _path(world, frame, lane, _PAVEMENT_M, _OTHER_LANE_M + _PAVEMENT_M) for lane in world.roads
    ]
    car_meshes = [car_mesh(colour, seed=i) for i, colour in enumerate(CAR_COLOURS)]
    person_meshes = [person_mesh(clothes) for clothes in _CLOTHES]
    all_cars = Crowd("car", car_meshes, _CAR_MPS)
    all_people = Crowd("person", person_meshes, _WALK_MPS)
    return (
        *place_movers(all_cars, driving, cars, rng, epoch_ns),
        *place_movers(all_people, walking, people, rng, epoch_ns),
    )


def _path(
    world: WorldInfo, frame: LocalFrame, lane: NDArray[np.float64], out_m: float, back_m: float
) -> Array:
    path = round_trip(lane, out_m, back_m)
    path[:, 2] = world.ground_height(path[:, 0], path[:, 1])
    frame_from_world = frame.ecef_from_enu.inverse @ world.frame.ecef_from_enu
    return frame_from_world.apply(path)


_TURN_M = 2.5  # half the length over which a direction is taken: objects turn smoothly at corners


@dataclass(frozen=True, eq=False)
class Mover:
    """An object that moves round a closed path at constant speed.

    path: (N, 3) world metres on the ground. phase_m: position on the path at `epoch_ns`
    (CLOCK_MONOTONIC). mesh: x forward, y left, z up, origin on the ground.
    """

    name: str
    path: Array
    speed_mps: float
    phase_m: float
    mesh: TileMesh
    epoch_ns: int = 0

    @cached_property
    def _lengths(self) -> Array:
        steps = np.diff(np.vstack([self.path, self.path[:1]]), axis=0)
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])

    def position_at(self, time_ns: int) -> Array:
        """Ground point (3,) below the object, world metres."""
        return self._point(self._travelled(time_ns))

    def velocity_at(self, time_ns: int) -> Array:
        """Velocity (3,) m/s, in the axes of `path`."""
        return self.speed_mps * self._direction(self._travelled(time_ns))

    def pose_at(self, time_ns: int) -> Pose:
        """world_from_object at a time: upright, x in the direction of motion."""
        s = self._travelled(time_ns)
        x, y = self._direction(s)[:2]
        c, n = np.array([x, y]) / max(np.hypot(x, y), 1e-9)
        return Pose(np.array([[c, -n, 0.0], [n, c, 0.0], [0.0, 0.0, 1.0]]), self._point(s))

    def placed_at(self, time_ns: int) -> TileMesh:
        """The object's mesh in world coordinates at a time."""
        return self.mesh.placed(self.pose_at(time_ns))

    def _travelled(self, time_ns: int) -> float:
        return self.phase_m + self.speed_mps * (time_ns - self.epoch_ns) * 1e-9

    def _point(self, s: float) -> Array:
        s = s % self._lengths[-1]
        closed = np.vstack([self.path, self.path[:1]])
        return np.array([np.interp(s, self._lengths, closed[:, axis]) for axis in range(3)])

    def _direction(self, s: float) -> Array:
        chord = self._point(s + _TURN_M) - self._point(s - _TURN_M)
        return np.asarray(chord / max(float(np.linalg.norm(chord)), 1e-9))


def round_trip(lane: ArrayLike, out_m: float, back_m: float) -> Array:
    """Closed path (2 N, 3) from an open lane (N, 3): forward with an offset of `out_m` to the right
    of the lane, then back with an offset of `back_m` to the right of that direction.
    """
    lane = np.asarray(lane, dtype=np.float64)
    return np.vstack([_parallel(lane, out_m), _parallel(lane[::-1], back_m)])


def _parallel(line: Array, offset_m: float) -> Array:
    """The line (N, 3), moved to its right."""
    tangent = np.gradient(line[:, :2], axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    right = np.column_stack([tangent[:, 1], -tangent[:, 0]])
    moved: Array = line.copy()
    moved[:, :2] += offset_m * right
    return moved


@dataclass(frozen=True)
class Crowd:
    """A kind of moving objects. prefix: start of their names; speeds_mps: lowest and highest."""

    prefix: str
    meshes: Sequence[TileMesh]
    speeds_mps: tuple[float, float]


def place_movers(
    crowd: Crowd,
    paths: Sequence[Array],
    count: int,
    rng: np.random.Generator,
    epoch_ns: int = 0,
) -> tuple[Mover, ...]:
    """Make `count` objects with random mesh and speed, at random places of the closed paths."""
    lengths = np.array(
        [np.linalg.norm(np.diff(np.vstack([p, p[:1]]), axis=0), axis=1).sum() for p in paths]
    )
    chosen = rng.choice(len(paths), count, p=lengths / lengths.sum())
    return tuple(
        Mover(
            name=f"{crowd.prefix}{i}",
            path=paths[k],
            speed_mps=float(rng.uniform(*crowd.speeds_mps)),
            phase_m=float(rng.uniform(0, lengths[k])),
            mesh=crowd.meshes[int(rng.integers(len(crowd.meshes)))],
            epoch_ns=epoch_ns,
        )
        for i, k in enumerate(chosen)
    )
