"""Moving cars and people of a generated world; the map does not contain them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array
from localizer.synth.tiles.props import CAR_COLOURS, car_mesh, person_mesh
from localizer.synth.world import WorldInfo
from sitl.camera.movers import Crowd, Mover, place_movers, round_trip

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
