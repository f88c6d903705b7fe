"""Associates a detector's boxes with earlier objects by their ground positions.

In the image everything moves with the camera. On the ground, static objects stay, and moving ones
keep their velocity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from localizer.geometry.pose import Array

_NEAR_M = 3.0  # a box's middle swings by as much from one picture to the next
_FASTEST_MPS = 25.0  # of what was seen once
_CHANGES_MPS2 = 3.0  # of what was seen twice or more
_KEPT_NS = 4_000_000_000
_SEEN = 2  # from how many sightings on a thing has a name
_FAR = 1e6


@dataclass(frozen=True)
class LocatedBox:
    """A box on the ground. label: name of its class; place: (3,) m, world axes."""

    label: str
    place: Array


@dataclass
class _Thing:
    name: str
    label: str
    place: Array
    time_ns: int
    velocity: Array | None = None
    sightings: int = 1

    def cost(self, sight: LocatedBox, time_ns: int) -> float:
        """Distance from the expected position over the allowed one; above 1: another object."""
        if sight.label != self.label:
            return _FAR
        dt = (time_ns - self.time_ns) * 1e-9
        if self.velocity is None:
            expected, reach = self.place, _NEAR_M + _FASTEST_MPS * dt
        else:
            expected = self.place + self.velocity * dt
            reach = _NEAR_M + _CHANGES_MPS2 * dt * max(dt, 1.0)
        return float(np.linalg.norm((sight.place - expected)[:2])) / reach

    def update(self, sight: LocatedBox, time_ns: int) -> None:
        """Update position and velocity with a box of this object."""
        dt = max((time_ns - self.time_ns) * 1e-9, 1e-3)
        fresh = (sight.place - self.place) / dt
        old = self.velocity
        self.velocity = fresh if old is None else 0.5 * (old + fresh)
        self.place, self.time_ns = sight.place, time_ns
        self.sightings += 1


class ObjectNames:
    """Names each object, over all frames: ``car 1``, ``car 2``. Not thread-safe."""

    def __init__(self) -> None:
        self._things: list[_Thing] = []
        self._count: dict[str, int] = {}

    def name(self, sights: list[LocatedBox], time_ns: int) -> list[str | None]:
        """A name for each box (`sights`) of the frame exposed at time_ns; None for an object seen
        for the first time, which may be a false detection. Call it in time order: it learns.
        """
        self._things = [t for t in self._things if time_ns - t.time_ns <= _KEPT_NS]
        names: list[str | None] = [None] * len(sights)
        costs = np.array([[t.cost(s, time_ns) for s in sights] for t in self._things])
        taken = set()
        if costs.size:
            for row, column in zip(*linear_sum_assignment(np.minimum(costs, _FAR)), strict=True):
                if costs[row, column] > 1.0:
                    continue
                thing = self._things[row]
                thing.update(sights[column], time_ns)
                taken.add(int(column))
                names[column] = thing.name if thing.sightings >= _SEEN else None
        for k, sight in enumerate(sights):
            if k not in taken:
                number = self._count[sight.label] = self._count.get(sight.label, 0) + 1
                name = f"{sight.label} {number}"
                self._things.append(_Thing(name, sight.label, sight.place, time_ns))
        return names
