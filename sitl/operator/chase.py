"""A car to follow, on a minute of road with two roofs that the map does not contain.

Under each roof the car is hidden for about two seconds. The aircraft stays above and behind it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.tile import TileMesh, build_mips
from localizer.synth.tiles.props import CAR_COLOURS, CAR_LENGTH_M, car_mesh
from localizer.synth.world import WorldInfo
from sitl.camera.movers import Mover, round_trip
from sitl.errors import SimulationError

CAR = "followed car"
SPEED_MPS = 6.0
_HIDDEN_S = 2.0
_ROOF_HEIGHT_M, _ROOF_WIDTH_M = 5.0, 9.0
_ROOFS_AFTER_S = (18.0, 40.0)  # from the place where it is clicked
_AHEAD_M = 60.0  # of road that is left behind the last roof
_OTHER_LANE_M = 4.4


@dataclass(frozen=True)
class Chase:
    """A car and the roofs that hide it. begin_m: path position at which it is clicked."""

    car: Mover
    roofs: tuple[Mover, ...]
    begin_m: float

    @property
    def movers(self) -> tuple[Mover, ...]:
        """Objects to draw in addition to the world's traffic."""
        return (self.car, *self.roofs)

    def hidden_ns(self) -> tuple[tuple[int, int], ...]:
        """Time spans (CLOCK_MONOTONIC) in which the car's centre is below a roof."""
        half = 0.5 * _roof_length()
        spans = []
        for after_s in _ROOFS_AFTER_S:
            middle = after_s * SPEED_MPS + self.begin_m - self.car.phase_m
            begin, end = ((middle + d) / SPEED_MPS * 1e9 for d in (-half, half))
            spans.append((self.car.epoch_ns + round(begin), self.car.epoch_ns + round(end)))
        return tuple(spans)

    def begins_ns(self) -> int:
        """CLOCK_MONOTONIC time at which the car is where it is clicked."""
        return self.car.epoch_ns + round((self.begin_m - self.car.phase_m) / SPEED_MPS * 1e9)


def make_chase(
    world: WorldInfo, frame: LocalFrame, epoch_ns: int, lead_s: float, seed: int = 0
) -> Chase:
    """Choose the road nearest to home that is long enough. frame: the map's ENU. The car reaches
    its begin_m lead_s after epoch_ns. Raises `SimulationError` if no road is long enough.
    """
    needed = _ROOFS_AFTER_S[-1] * SPEED_MPS + 0.5 * _roof_length() + _AHEAD_M
    frame_from_world = frame.ecef_from_enu.inverse @ world.frame.ecef_from_enu
    best: tuple[float, Array, float] | None = None
    for lane in world.roads:
        path = round_trip(lane, 0.0, _OTHER_LANE_M)
        path[:, 2] = world.ground_height(path[:, 0], path[:, 1])
        path = frame_from_world.apply(path)
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        one_way = float(along[len(lane) - 1])
        for start in np.arange(20.0, one_way - needed - 20.0, 20.0):
            place = np.array([np.interp(start, along, path[:, k]) for k in range(2)])
            away = float(np.hypot(*place))
            if best is None or away < best[0]:
                best = (away, path, float(start))
    if best is None:
        raise SimulationError(f"no road of {needed:.0f} m in this world")
    _, path, start = best
    rng = np.random.default_rng([seed, 97])
    mesh = car_mesh(CAR_COLOURS[int(rng.integers(len(CAR_COLOURS)))], seed=seed)
    car = Mover(CAR, path, SPEED_MPS, start - lead_s * SPEED_MPS, mesh, epoch_ns)
    roofs = tuple(
        Mover(f"roof {k}", path, 0.0, start + s * SPEED_MPS, _roof(seed + k), epoch_ns)
        for k, s in enumerate(_ROOFS_AFTER_S)
    )
    return Chase(car, roofs, start)


def pursuit(car: Mover, time_ns: int, height_m: float, behind_m: float) -> Array:
    """Desired aircraft position (3,), map ENU: above and behind the car."""
    velocity = car.velocity_at(time_ns)
    ahead = velocity / max(float(np.linalg.norm(velocity)), 1e-9)
    place: Array = car.position_at(time_ns) - behind_m * ahead
    place[2] += height_m
    return place


def _roof_length() -> float:
    """Length (m) at which the whole car is below the roof for the wanted time."""
    return _HIDDEN_S * SPEED_MPS + CAR_LENGTH_M


def _roof(seed: int) -> TileMesh:
    """A flat roof along x, as a tarpaulin over a market street."""
    half_l, half_w = 0.5 * _roof_length(), 0.5 * _ROOF_WIDTH_M
    corners = [(-1, -1), (1, -1), (-1, 1), (1, 1)]
    positions = np.array([[a * half_l, b * half_w, _ROOF_HEIGHT_M] for a, b in corners], np.float32)
    uv = np.array([[(a + 1) / 2, (b + 1) / 2] for a, b in corners], np.float32)
    rng = np.random.default_rng([seed, 101])
    cells = rng.uniform(90, 200, (8, 16, 1)) * np.ones(3)
    texture = np.kron(cells, np.ones((8, 8, 1))) + rng.normal(0, 6, (64, 128, 3))
    image = np.clip(texture, 0, 255).astype(np.uint8)
    triangles = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    return TileMesh(positions, uv, triangles, build_mips(image), Pose.identity())
